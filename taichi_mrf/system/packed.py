"""Packed bytes from outside, unpacked without trust.

One sum over all that is unpacked of a file bounds it, whatever its format: so many bytes, or so many times
what the file takes. Measurements pack three to twenty times, arrays of a single value a thousandfold.
"""

import zipfile
from pathlib import Path
from typing import IO, BinaryIO

from taichi_mrf.errors import TaichiMRFError, said
from taichi_mrf.system.files import ErrorType
from taichi_mrf.system.memory import check_memory

DEFLATE_RATIO = 1032
"""The highest compression ratio of deflate (zlib's technical details)."""

LEAST_BYTES, LARGEST_RATIO = 1 << 28, 100

TEXT = 8
"""Weight of a byte of text: the numbers and lists made from it take that many bytes and more."""


class UnpackedBytes:
    """The sum for a file of ``packed_bytes``; what is unpacked again does not count again."""

    def __init__(self, packed_bytes: int) -> None:
        self._packed, self._sum, self._counted = packed_bytes, 0, dict[str, int]()

    def count(self, name: str, unpacked: int, weight: int = 1) -> None:
        """Count what is unpacked of a part of the file. Raises ValueError, which says how much that is."""
        total = self._sum + weight * unpacked - self._counted.get(name, 0)
        if total > max(LEAST_BYTES, LARGEST_RATIO * self._packed):
            packed = f"{self._packed / 1e6:.3g} MB"
            raise ValueError(f"unpacks to {unpacked / 1e9:.3g} GB, too much for a file of {packed}")
        self._sum, self._counted[name] = total, weight * unpacked


class ZipMembers:
    """The members of a zip that is open for reading. Errors are ``error`` with the file's name and the
    member's."""

    def __init__(self, path: Path, stream: BinaryIO, error: ErrorType) -> None:
        """Raises the errors of the zipfile module, which are of many kinds."""
        self.path, self.archive, self._error = path, zipfile.ZipFile(stream), error
        self.members = {info.filename: info for info in self.archive.infolist()}
        self._sum = UnpackedBytes(stream.seek(0, 2))

    def open(self, name: str) -> IO[bytes]:
        """Open a member. Python's other unpackers have no bound: a kilobyte of bzip2 fills gigabytes."""
        info = self.members[name]
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise self.problem(name, f"is packed by the method {info.compress_type}, not by deflate")
        return self.archive.open(info)

    def count(self, name: str, weight: int = 1) -> None:
        """Count a member, before it is read whole. Raises for a size that the file cannot hold or may not
        have, and CapacityError."""
        info = self.members[name]
        if info.file_size > DEFLATE_RATIO * (info.compress_size + 1):
            raise self.problem(name, f"claims {info.file_size / 1e9:.3g} GB, more than the file can hold")
        try:
            self._sum.count(name, info.file_size, weight)
        except ValueError as problem:
            raise self.problem(name, str(problem)) from None
        check_memory(weight * info.file_size, f"{self.path}: {name}")

    def read(self, name: str, weight: int = 1) -> bytes:
        """A member's content."""
        self.count(name, weight)
        try:
            with self.open(name) as stream:
                return stream.read()
        except TaichiMRFError:
            raise
        except Exception as error:  # zipfile and zlib raise many kinds
            raise self.problem(name, f"cannot be read: {said(error)}") from error

    def problem(self, name: str, problem: str) -> Exception:
        """The error for a member."""
        return self._error(f"{self.path}: {name.removesuffix('.npy')} {problem}")
