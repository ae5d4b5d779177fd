"""NumPy's npz files, read without trust: damaged, truncated and inflated files are refused in one line.

numpy.load checks a member's checksum only if the member is read to its end, allocates what a header claims
before it reads the values, and passes on whatever exception its parsers raise.
"""

import contextlib
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError, TaichiMRFError, said
from taichi_mrf.system.files import open_regular
from taichi_mrf.system.packed import ZipMembers

MANIFEST = "manifest"
"""The member that lists the others with their checksums: ``name crc32 bytes`` each."""

_CHUNK = 1 << 20
_MOST_DIMENSIONS = 8

Shape = tuple[int, ...]
ErrorType = Callable[[str], TaichiMRFError]


class NpzFile:
    """An open file; ``file[name]`` reads an array to its end, and so checks its checksum."""

    def __init__(self, path: Path, zipped: ZipMembers, error: ErrorType) -> None:
        self._path, self._zip, self._error = path, zipped, error
        self._members = {name.removesuffix(".npy"): info for name, info in zipped.members.items()}

    @property
    def names(self) -> list[str]:
        """Names of the arrays."""
        return list(self._members)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def header(self, name: str) -> tuple[Shape, np.dtype]:
        """An array's shape and type, without reading its values."""
        with self._member(name) as (_, shape, _, dtype):
            return shape, dtype

    def __getitem__(self, name: str) -> NDArray[Any]:
        with self._member(name) as (stream, shape, fortran, dtype):
            size = math.prod(shape) * dtype.itemsize
            info = self._members[name]
            if stream.tell() + size != info.file_size:
                raise self.problem(name, f"is {dtype} {shape} by its header, but has {info.file_size} bytes")
            self._zip.count(info.filename)
            values, place = np.empty(size, np.uint8), 0
            while chunk := stream.read(_CHUNK):
                values[place : place + len(chunk)] = np.frombuffer(chunk, np.uint8)
                place += len(chunk)
            if place != size:
                raise self.problem(name, "ends too early")
            array = values.view(dtype) if size else np.empty(0, dtype)
            return array.reshape(shape, order="F" if fortran else "C")

    def array(self, name: str, kinds: str, shape: Sequence[int | None]) -> NDArray[Any]:
        """An array of one of these kinds (NumPy's letters) and of this shape, where None is any length.

        Raises the file's error for any other array, and for values that are not finite.
        """
        found = self[name]
        fits = len(found.shape) == len(shape) and all(
            n is None or n == m for n, m in zip(shape, found.shape, strict=True)
        )
        if found.dtype.kind not in kinds or not fits:
            wanted = ", ".join("N" if n is None else str(n) for n in shape)
            raise self.problem(
                name, f"is {found.dtype} {found.shape}; expected ({wanted}) of another type or shape"
            )
        if found.dtype.kind == "f" and not np.isfinite(found).all():
            raise self.problem(name, "holds a value that is not finite")
        if found.dtype.kind == "U" and not _is_text(found):
            raise self.problem(name, "holds a character outside Unicode")
        return found

    def integers(self, name: str, shape: Sequence[int | None], least: int, most: int) -> NDArray[Any]:
        """An array of this shape of whole numbers from ``least`` to ``most``; raises the file's error for any
        other array."""
        found = self.array(name, "iu", shape)
        beyond = (found < least) | (found > most)
        if beyond.any():
            raise self.problem(name, f"holds {found[beyond][0]}, which is not from {least} to {most}")
        return found

    def scalar(self, name: str, kinds: str) -> Any:
        """One value of one of these kinds."""
        return self.array(name, kinds, ()).item()

    @contextmanager
    def values_of(self, name: str) -> Iterator[None]:
        """Errors of this package that the block raises of an array's values name the array and the file."""
        try:
            yield
        except TaichiMRFError as error:
            if isinstance(error, CapacityError) or str(error).startswith(f"{self._path}: "):
                raise
            raise self.problem(name, f"is damaged: {error}") from error

    def check_manifest(self) -> None:
        """Raise the file's error if its members differ from those in its manifest."""
        wanted = sorted(self.array(MANIFEST, "U", (None,)).tolist())
        found = sorted(manifest_lines(i for name, i in self._members.items() if name != MANIFEST))
        if wanted != found:
            odd = min(set(wanted) ^ set(found), default="").split()
            raise self._error(f"{self._path}: damaged: {odd[0] if odd else MANIFEST} is not what was saved")

    def check(self) -> None:
        """Read all arrays to their ends. Raises the file's error for one that differs from its checksum."""
        for name in self.names:
            with self._member(name) as (stream, *_):
                while stream.read(_CHUNK):
                    pass

    @contextmanager
    def _member(self, name: str) -> Iterator[tuple[Any, Shape, bool, np.dtype]]:
        """A member's stream after its header, and the header's values."""
        if name not in self._members:
            raise self.problem(name, "is missing")
        try:
            with self._zip.open(self._members[name].filename) as stream:
                shape, fortran, dtype = _read_header(stream)
                yield stream, shape, fortran, dtype
        except TaichiMRFError:
            raise
        except Exception as error:  # zipfile, zlib and NumPy raise many kinds of exceptions
            raise self.problem(name, f"cannot be read: {said(error)}") from error

    def problem(self, name: str, problem: str) -> TaichiMRFError:
        """The file's error about an array, which names both."""
        return self._error(f"{self._path}: {name} {problem}")


@contextmanager
def open_npz(path: Path, error: ErrorType, what: str) -> Iterator[NpzFile]:
    """The arrays of a file, by name. Raises ``error``, which names the file, for anything wrong with it;
    ``what`` is the expected content, such as "a readable map". Raises CapacityError if an array does not fit
    into memory."""
    with contextlib.ExitStack() as opened:
        stream = opened.enter_context(open_regular(path, error))
        try:
            zipped = ZipMembers(path, stream, error)
            archive = opened.enter_context(zipped.archive)
        except OSError as problem:
            raise error(f"{path}: cannot be read: {problem.strerror or problem}") from problem
        except Exception as problem:  # as above
            raise error(f"{path}: not {what}: {said(problem)}") from problem
        try:
            _compare_names(archive)
        except Exception as problem:
            raise error(f"{path}: not {what}: {said(problem)}") from problem
        try:
            yield NpzFile(path, zipped, error)
        except CapacityError:
            raise
        except MemoryError as problem:
            raise error(f"{path}: does not fit into memory") from problem


def _is_text(array: NDArray[np.str_]) -> bool:
    """True if every character is in Unicode; Python raises SystemError for others."""
    if array.dtype.itemsize == 0:
        return True
    codes = np.ascontiguousarray(array).reshape(-1).view(np.dtype("u4").newbyteorder(array.dtype.byteorder))
    return not (codes > sys.maxunicode).any()


def _compare_names(archive: ZipFile) -> None:
    """Open each member, which compares its name in the directory with the one in its own header. Otherwise an
    array with a damaged name would count as missing."""
    for info in archive.infolist():
        archive.open(info).close()


def manifest_lines(members: Iterator[ZipInfo]) -> list[str]:
    """The manifest's lines for members of an archive."""
    return [f"{i.filename.removesuffix('.npy')} {i.CRC:08x} {i.file_size}" for i in members]


def read_npy(path: Path) -> NDArray[Any]:
    """The array of a ``.npy`` file. Raises OSError, and ValueError for a file that holds anything but one
    array, to its last byte."""
    with open_regular(path, OSError) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        try:
            shape, fortran, dtype = _read_header(stream)
        except Exception as error:  # as above
            raise ValueError(said(error)) from error
        held = math.prod(shape) * dtype.itemsize
        if stream.tell() + held != size:
            raise ValueError(f"it is {dtype} {shape} by its header, but has {size} bytes")
        values = np.frombuffer(stream.read(), dtype) if held else np.empty(0, dtype)
    return values.reshape(shape, order="F" if fortran else "C")


def _read_header(stream: Any) -> tuple[Shape, bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    first = version == (1, 0)
    read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(stream)
    if dtype.hasobject or len(shape) > _MOST_DIMENSIONS or any(n < 0 for n in shape):
        raise ValueError(f"{dtype} {shape} is not an array of plain values")
    return tuple(shape), fortran, dtype
