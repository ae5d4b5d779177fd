"""The exceptions that the library raises. Only the command line turns them into messages and exit codes."""


class TaichiMRFError(Exception):
    """Base of everything that this package raises on purpose; its text is one clear line for a person."""


class ConfigError(TaichiMRFError):
    """A parameter is unknown, of the wrong type or outside its range; the text names the field."""


class ArgumentError(ConfigError, ValueError):
    """An argument of a public function has an impossible value; the text names the argument."""


class ArgumentTypeError(ConfigError, TypeError):
    """An argument of a public function is of the wrong type; the text names the argument."""


class BackendError(TaichiMRFError):
    """The wanted Taichi backend is not to be had, or Taichi already runs on another one."""


class CapacityError(TaichiMRFError):
    """The map would need more memory or more space than there is; the text says how much."""


class DatasetError(TaichiMRFError):
    """A recording cannot be read; the text names the folder or the file."""


class FrameError(DatasetError):
    """One frame of a recording is broken; the text names the frame and the file.

    With ``--skip-bad-frames`` these are counted in the report instead of ending the run.
    """


class LostFrameError(FrameError):
    """Where a frame was taken could not be found out; the text names the frame and says why."""


class KeyframeError(TaichiMRFError):
    """A keyframe does not exist, is frozen, or was given data of the wrong shape."""


class MapFileError(TaichiMRFError):
    """A saved map cannot be read or written; the text names the file."""


class ViewerError(TaichiMRFError):
    """The page cannot be served, or viser is not the version that it is guarded against."""


class ClusterError(TaichiMRFError):
    """The scheduler does not answer, or tasks were lost because every process that took them died.

    ``lost`` says, by the task's index, what became of each such task; the others are done.
    """

    def __init__(self, text: str, lost: dict[int, str] | None = None) -> None:
        super().__init__(text)
        self.lost = lost or {}


def said(error: BaseException) -> str:
    """What an exception of another package says, in one line that is not too long to be read."""
    return " ".join(str(error).split())[:_LONGEST] or type(error).__name__


_LONGEST = 200


class CutShortError(Exception):
    """The run has to end within seconds (SIGTERM), and this part of it is left out. No error for a user: the
    caller goes on with the next part."""
