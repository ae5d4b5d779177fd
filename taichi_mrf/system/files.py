"""Files from outside, opened without trust.

Reading a FIFO, a socket or a device in a file's place blocks or never ends, so only regular files are
opened. The tests for a path answer False where the system would raise, such as for a path that is too long;
opening such a path gives the reason.
"""

import codecs
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from taichi_mrf.system.memory import check_memory

ErrorType = Callable[[str], Exception]
"""Makes the error to raise from its text."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}

_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def exists(path: str | Path) -> bool:
    """True if a path exists; False also for a path that is too long or that may not be seen."""
    return os.path.exists(path)


def is_file(path: str | Path) -> bool:
    """True if a path is a regular file, or a link to one."""
    return os.path.isfile(path)


def is_folder(path: str | Path) -> bool:
    """True if a path is a folder, or a link to one."""
    return os.path.isdir(path)


def kind_of(mode: int) -> str | None:
    """Kind of thing at a path, by its ``st_mode``: "a FIFO", "a device"; None for a regular file."""
    return None if stat.S_ISREG(mode) else _KINDS.get(stat.S_IFMT(mode), "something else")


def check_regular(path: str | Path, error: ErrorType, missing: str = "there is no such file") -> int:
    """The size in bytes of a regular file. Raises ``error``, which names the path and says what is there
    instead; ``missing`` if nothing is."""
    try:
        found = os.stat(path)
    except FileNotFoundError as problem:
        raise error(f"{path}: {missing}") from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    except ValueError as problem:  # a zero byte
        raise error(f"{str(path)!r}: not the name of a file: {problem}") from problem
    kind = kind_of(found.st_mode)
    if kind is not None:
        raise error(f"{path}: cannot be read: it is {kind}, not a regular file")
    return found.st_size


def open_regular(path: str | Path, error: ErrorType, missing: str = "there is no such file") -> BinaryIO:
    """Open a regular file to read its bytes. Raises ``error`` as :func:`check_regular` does."""
    check_regular(path, error, missing)
    try:
        # Whoever puts a FIFO in the file's place after the check cannot make the opening wait either.
        file = os.fdopen(os.open(path, _FLAGS), "rb")
    except OSError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    kind = kind_of(os.fstat(file.fileno()).st_mode)
    if kind is not None:
        file.close()
        raise error(f"{path}: cannot be read: it is {kind}, not a regular file")
    return file


def read_bytes(
    path: str | Path,
    error: ErrorType,
    missing: str = "there is no such file",
    most_bytes: int | None = None,
) -> bytes:
    """All bytes of a regular file. Raises ``error`` as :func:`check_regular` does, also for a file of more
    than ``most_bytes``, and CapacityError for one that does not fit into memory."""
    with open_regular(path, error, missing) as file:
        size = os.fstat(file.fileno()).st_size
        if most_bytes is not None and size > most_bytes:
            raise error(f"{path}: has {size:,} bytes; at most {most_bytes:,} are expected")
        check_memory(size, f"{path}")
        try:
            return file.read()
        except OSError as problem:
            raise error(f"{path}: cannot be read: {problem.strerror or problem}") from problem


def read_text(
    path: str | Path,
    error: ErrorType,
    missing: str = "there is no such file",
    most_bytes: int | None = None,
) -> str:
    """A text file, its line ends as ``\\n``. Raises as :func:`read_bytes` does, and ``error`` for a file that
    is no text."""
    try:
        text = decoded(read_bytes(path, error, missing, most_bytes))
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text file: {problem}") from problem
    return text.replace("\r\n", "\n").replace("\r", "\n")


def decoded(data: bytes, errors: str = "strict") -> str:
    """UTF-8, or UTF-16 with a byte-order mark, without the mark. Raises UnicodeDecodeError."""
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if wide else "utf-8-sig", errors)
