"""The exceptions and warnings of the library. Only the command line turns them into messages and exit
codes."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class TaichiMRFError(Exception):
    """Base of all exceptions of this package. The text is one line that a user can read."""


class ConfigError(TaichiMRFError):
    """A parameter is unknown, of the wrong type or outside its range; the text names the field."""


class ArgumentError(ConfigError, ValueError):
    """An argument of a public function has an impossible value; the text names the argument."""


class ArgumentTypeError(ConfigError, TypeError):
    """An argument of a public function is of the wrong type; the text names the argument."""


class BackendError(TaichiMRFError):
    """The requested Taichi backend is not available, or Taichi already runs on another one or in another
    thread."""


class CapacityError(TaichiMRFError):
    """Not enough memory, or a map beyond its spatial limit; the text says how much is needed."""


class DatasetError(TaichiMRFError):
    """A recording cannot be read; the text names the folder or the file."""


class ReadWrongError(DatasetError):
    """A recording is certainly misread; the text names the contradiction and the command that corrects it."""


class FrameError(DatasetError):
    """One frame of a recording is broken; the text names the frame and the file.

    With ``--skip-bad-frames`` such frames are counted in the report and do not end the run.
    """


class LostFrameError(FrameError):
    """Tracking found no pose for a frame; the text names the frame and the reason."""


class KeyframeError(TaichiMRFError):
    """A keyframe does not exist or is frozen, or its depth image or pose is not valid."""


class MapFileError(TaichiMRFError):
    """A saved map cannot be read or written; the text names the file."""


class ViewerError(TaichiMRFError):
    """The page cannot be served, or the installed viser is not the version that the guard supports."""


class ClusterError(TaichiMRFError):
    """The scheduler does not answer, or tasks were lost because every process that ran them died.

    ``lost`` says for each lost task, by its index, what happened to it; the others are done.
    """

    def __init__(self, text: str, lost: dict[int, str] | None = None) -> None:
        super().__init__(text)
        self.lost = lost or {}


def said(error: BaseException) -> str:
    """The text of an exception of another package, on one line and not too long."""
    return " ".join(str(error).split())[:_LONGEST] or type(error).__name__


_LONGEST = 200


@contextmanager
def naming(where: object, *kinds: type[Exception]) -> Iterator[None]:
    """Raise what the block raises of some ``kinds``, DatasetError by default, as a DatasetError that begins
    with ``where``, if it is not empty: what reads a part of a file need not know its name."""
    caught = kinds or (DatasetError,)
    try:
        yield
    except caught as error:
        raise DatasetError(f"{where}: {error}" if where else str(error)) from error


@contextmanager
def collected_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Warnings of this package while the block runs, to be told in a report or as notes."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module="taichi_mrf")
        yield warned


class CutShortError(Exception):
    """The run has to end within seconds (SIGTERM), and this part of it is left out. No error for a user: the
    caller goes on with the next part."""
