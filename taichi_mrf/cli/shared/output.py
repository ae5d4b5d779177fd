"""The folder that a run writes to: writable before the work starts, used by one run at a time, removed if it
stays empty."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

from taichi_mrf.errors import MapFileError
from taichi_mrf.system.atomic import atomic_path, remove_leftovers
from taichi_mrf.system.files import exists, is_folder

LOCK_FILE = ".lock"

_RETRY_S = 0.2


@contextmanager
def output_folder(folder: Path, locked: bool = True, patience_s: float = 0.0) -> Iterator[None]:
    """Make a folder and try to write to it, lock it against other runs, remove what a killed run has left
    half written; on leaving, remove what was made here if it is still empty.

    Waits ``patience_s`` for another run that holds it. Raises MapFileError, which names the folder, if it
    cannot be made or written to, and the other process if one uses it.
    """
    made = _missing_folders(folder)
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MapFileError(f"{folder}: cannot be made: {error.strerror or error}") from error
        _try_writing(folder)
        with _lock(folder, patience_s if locked else None):
            remove_leftovers(folder)
            yield
    finally:
        for each in made:
            if is_folder(each) and not any(each.iterdir()):
                each.rmdir()


@contextmanager
def _lock(folder: Path, patience_s: float | None) -> Iterator[None]:
    """Hold the folder's lock file while the block runs; with a patience of None, or on Windows, nothing.

    The system gives the lock up with the process, however that ends: a lock file that is left is no lock.
    """
    if patience_s is None or fcntl is None:
        yield
        return
    path = folder / LOCK_FILE
    until = time.monotonic() + patience_s
    descriptor = _locked(path)
    while descriptor is None:
        if time.monotonic() >= until:
            holder = path.read_text(encoding="utf-8", errors="replace").strip() if path.exists() else ""
            raise MapFileError(f"{folder}: another run uses this folder ({holder or 'unknown process'})")
        time.sleep(_RETRY_S)
        descriptor = _locked(path)
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(path: Path) -> int | None:
    """The descriptor of the lock file if nobody else holds its lock."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
            return descriptor
    except OSError:
        pass
    os.close(descriptor)
    return None


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
