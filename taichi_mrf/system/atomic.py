"""Atomic writing: a file is written beside the target, then renamed to it.

A reader, or a run that is resumed after a crash or a full disk, finds the old file or the new one, never half
of one.
"""

import contextlib
import os
import re
import secrets
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.system.files import kind_of
from taichi_mrf.system.npz_file import MANIFEST, manifest_lines


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to; on success the file there takes the place of ``path``.

    The temporary path lies in the same folder (so that the move is a rename) and has the same suffix
    (so that writers that go by it work). If anything is raised inside the ``with`` block, ``path``
    stays as it was and the temporary file is removed. A symbolic link stays a link: the file that it
    points to is replaced. Raises MapFileError, which names ``path`` and the reason, if it cannot be written,
    and if a folder, a device or anything else that is no regular file is there.
    """
    try:
        target = _target_of(path)
        temporary = temporary_name(target)
        try:
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise MapFileError(f"{path}: cannot be written: {error.strerror or error}") from error


def _target_of(path: str | Path) -> Path:
    """The file that a path, or a link, stands for. Raises MapFileError for anything but a regular file."""
    if "\0" in str(path):
        raise MapFileError(f"{str(path)!r}: not the name of a file: it holds a zero byte")
    target = Path(os.path.realpath(path))
    try:
        kind = kind_of(os.stat(target).st_mode)
    except FileNotFoundError:
        return target
    if kind is not None:
        raise MapFileError(f"{path}: cannot be written: it is {kind}, not a regular file")
    return target


def temporary_name(target: Path) -> Path:
    """A new name beside ``target`` that holds the process's number, for :func:`remove_leftovers`."""
    # Shortened, so that the name is not too long where the target's is not.
    begin = target.stem.encode()[:_LONGEST_STEM].decode("utf-8", "ignore")
    return target.with_name(f".{begin}.part-{os.getpid()}-{secrets.token_hex(4)}{target.suffix}")


_LONGEST_STEM = 100


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files and folders that killed processes have left in a folder, if it exists.

    Those of running processes stay, and those that cannot be removed.
    """
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _LEFTOVER.search(path.name)
        if match and not _lives(int(match[1])):
            with contextlib.suppress(OSError):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink()


_LEFTOVER = re.compile(r"^\..*\.part-(\d+)-[0-9a-f]{8}(\.\w+)?$")


def _lives(pid: int) -> bool:
    if os.name == "nt":  # there a signal ends a process, and a file that is open cannot be removed anyway
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file, newlines as they are. Raises MapFileError."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8"))


def write_npz(path: str | Path, arrays: Mapping[str, NDArray[Any]], manifest: bool = False) -> None:
    """Write arrays by name to a compressed file that ``numpy.load`` reads, with a
    manifest (NpzFile.check_manifest) if ``manifest`` is true. Raises MapFileError.

    The same arrays always give the same bytes. Compression level 1 instead of the 6 of
    ``numpy.savez_compressed``: for maps it is several times faster and the file hardly larger.
    """
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            _write_member(archive, name, array)
        if manifest:
            _write_member(archive, MANIFEST, np.array(manifest_lines(iter(archive.infolist()))))


def _write_member(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    # A member opened by name gets the date 1980-01-01, not today's.
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
