"""The files of a Record3D recording, in a .r3d (a zip) or in a folder, read without trust.

Depth and confidence are packed with LZFSE or as they are. An LZFSE stream is a row of blocks, each of which
says how many bytes it holds; they are added up before anything is unpacked. Unpacking needs the extra
``record3d``.
"""

import struct
import weakref
import zipfile
from pathlib import Path
from typing import Any, Protocol

from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.files import is_file, is_folder, open_regular, read_bytes
from taichi_mrf.system.libraries import library
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.npz_file import DEFLATE_RATIO

MISSING = "the file is missing"
_LZFSE, _END = b"bvx", b"bvx$"
_LEAST_HEADER = 32
"""Bytes of an LZFSE block's header without its table of frequencies."""

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class Files(Protocol):
    """The files of a recording by their names in it, such as ``rgbd/0.depth``."""

    names: frozenset[str]

    def where(self, name: str) -> str:
        """Name of a file in errors."""

    def read(self, name: str, most_bytes: int) -> bytes:
        """A file's content. Raises DatasetError, which names the file, if it is missing, damaged or larger
        than ``most_bytes``."""


class ZippedFiles:
    """The files in a .r3d."""

    def __init__(self, path: Path) -> None:
        """Raises DatasetError, which names the file, if it is no zip."""
        self.path = path
        stream = open_regular(path, DatasetError)
        try:
            self._archive = zipfile.ZipFile(stream)
            self._members = {info.filename: info for info in self._archive.infolist()}
        except Exception as error:  # zipfile raises many kinds of errors
            stream.close()
            raise DatasetError(f"{path}: not a recording of Record3D: {said(error)}") from error
        self.names = frozenset(self._members)
        weakref.finalize(self, stream.close)

    def where(self, name: str) -> str:
        return f"{self.path}: {name}"

    def read(self, name: str, most_bytes: int) -> bytes:
        info = self._members.get(name)
        if info is None:
            raise DatasetError(f"{self.where(name)}: {MISSING}")
        size = info.file_size
        if size > most_bytes or size > DEFLATE_RATIO * (info.compress_size + 1):
            raise DatasetError(
                f"{self.where(name)}: claims {size:,} bytes; at most {most_bytes:,} are expected"
            )
        if info.compress_type not in _METHODS:
            raise DatasetError(
                f"{self.where(name)}: is packed by the method {info.compress_type}, not by deflate"
            )
        check_memory(size, self.where(name))
        try:
            return self._archive.read(info)
        except Exception as error:
            raise DatasetError(f"{self.where(name)}: cannot be read: {said(error)}") from error


class UnpackedFiles:
    """The files in a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        inside = [path, *(child for child in path.iterdir() if is_folder(child))]
        self.names = frozenset(
            file.relative_to(path).as_posix()
            for folder in inside
            for file in folder.iterdir()
            if is_file(file)
        )

    def where(self, name: str) -> str:
        return str(self.path / name)

    def read(self, name: str, most_bytes: int) -> bytes:
        return read_bytes(self.path / name, DatasetError, MISSING, most_bytes)


def open_files(path: Path) -> Files:
    """The files of a recording. Raises DatasetError, which names the file."""
    return UnpackedFiles(path) if is_folder(path) else ZippedFiles(path)


def is_packed(data: bytes) -> bool:
    """True if the content of a file of depth or confidence is an LZFSE stream."""
    return data.startswith(_LZFSE)


def unpacker() -> Any:
    """The library that unpacks LZFSE. Raises DatasetError, which says what to install."""
    return library("lzfse", "depth that Record3D has packed needs", "record3d", DatasetError)


def held_bytes(data: bytes) -> int:
    """How many bytes the content of a file of depth or confidence has, unpacked. Raises DatasetError, which
    names no file, for an LZFSE stream that is damaged."""
    if not is_packed(data):
        return len(data)
    place = total = 0
    try:
        while data[place : place + 4] != _END:
            kind, held = struct.unpack_from("<4sI", data, place)
            total += held
            place += _block_bytes(kind, held, data, place)
    except struct.error:
        raise DatasetError("is cut short") from None
    return total


def unpacked(data: bytes, expected_bytes: int) -> bytes:
    """The content of a file of depth or confidence. Raises DatasetError, which names no file, if it is
    damaged or holds another number of bytes than expected, and what to install if it is packed and the
    library is missing."""
    held = held_bytes(data)
    if held != expected_bytes:
        raise DatasetError(f"holds {held:,} bytes, expected {expected_bytes:,}")
    if not is_packed(data):
        return data
    lzfse = unpacker()
    try:
        content: bytes = lzfse.decompress(data)
    except Exception as error:
        raise DatasetError("is damaged, it cannot be unpacked") from error
    if len(content) != expected_bytes:
        raise DatasetError(f"unpacks to {len(content):,} bytes, expected {expected_bytes:,}")
    return content


def _block_bytes(kind: bytes, held: int, data: bytes, place: int) -> int:
    """The size of a block of an LZFSE stream with its header."""
    if kind == b"bvx-":  # as it is
        return 8 + held
    if kind == b"bvxn":  # LZVN
        return 12 + int(struct.unpack_from("<I", data, place + 8)[0])
    if kind == b"bvx2":  # the sizes of literals and matches are fields of 20 bits
        literals, matches, header = struct.unpack_from("<QQI", data, place + 8)
        if header >= _LEAST_HEADER:
            return int(header + (literals >> 20 & 0xFFFFF) + (matches >> 40 & 0xFFFFF))
    raise DatasetError(f"holds an unknown block, {kind!r}: it is damaged")
