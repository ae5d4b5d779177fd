"""The folder that a run writes to: writable before the work starts, gone again if it stays empty."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from taichi_mrf.errors import MapFileError
from taichi_mrf.system.atomic import atomic_path, remove_leftovers
from taichi_mrf.system.files import exists, is_folder

DID_NOT_FIT = 3
"""Exit status of a run for which memory was not enough: what did fit is mapped and kept."""


@contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Make a folder and try to write to it, remove what a killed run has left half written; on leaving,
    remove what was made here if it is still empty.

    Raises MapFileError, which names the folder, if it cannot be made or written to.
    """
    made = _missing_folders(folder)
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MapFileError(f"{folder}: cannot be made: {error.strerror or error}") from error
        _try_writing(folder)
        remove_leftovers(folder)
        yield
    finally:
        for each in made:
            if is_folder(each) and not any(each.iterdir()):
                each.rmdir()


def _missing_folders(folder: Path) -> list[Path]:
    """The folder and its parents that do not exist yet, innermost first."""
    return [each for each in (folder, *folder.parents) if not exists(each)]


def _try_writing(folder: Path) -> None:
    probe = folder / ".probe"
    try:
        with atomic_path(probe) as temporary:
            temporary.write_bytes(b"1")
        probe.unlink()
    except (MapFileError, OSError) as error:
        reason = getattr(error.__cause__ or error, "strerror", None) or error
        raise MapFileError(f"{folder}: cannot be written to: {reason}") from error
