"""Bounds on what the compressed parts of a bag unpack to: chunks, single messages, whole files.

rosbags unpacks each of them to whatever it holds, which for a file of 65 kB may be gigabytes. Its readers
look the unpackers of chunks up in tables, and take those of messages and files from a module;
:func:`bound_unpacking` puts bounded ones in their places.
"""

import bz2
import importlib
import os
from collections.abc import Callable
from typing import Any, BinaryIO, Protocol

_LEAST_BOUND, _LARGEST_RATIO = 1 << 26, 1000
"""Chunks are a few megabytes, and one large image at most; images of a single value pack a thousandfold."""

_LEAST_FILE, _LARGEST_FILE_RATIO = 1 << 28, 100
"""A whole file, which is unpacked to the disk. Recordings pack three to twenty times."""


class _Unpacker(Protocol):
    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def bound_unpacking() -> None:
    """Let rosbags unpack no more than a bound; to do so again changes nothing."""
    unpackers: dict[str, Callable[[], _Unpacker]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": importlib.import_module("lz4.frame").LZ4FrameDecompressor,
        "zstd": _zstd().ZstdDecompressor,
    }
    ros1 = importlib.import_module("rosbags.rosbag1.reader").decompressors
    mcap = importlib.import_module("rosbags.rosbag2.storage_mcap").DECOMPRESSORS
    for table in (ros1, mcap):
        for name in set(table) & set(unpackers):
            table[name] = _bounded(unpackers[name], "chunk")
    vars(importlib.import_module("rosbags.rosbag2.reader"))["zstd"] = _BoundedZstd()


class _BoundedZstd:
    """The two functions of the module ``zstd`` with which rosbags reads ROS 2 bags: ``decompress`` for a
    message, ``open`` for a file."""

    def __init__(self) -> None:
        self.decompress = _bounded(_zstd().ZstdDecompressor, "message")

    def open(self, packed: BinaryIO, mode: str) -> "_BoundedFile":
        return _BoundedFile(_zstd().open(packed, mode), os.fstat(packed.fileno()).st_size)


class _BoundedFile:
    """A file that is unpacked while it is read, up to a bound."""

    def __init__(self, stream: BinaryIO, packed_bytes: int) -> None:
        self._stream, self._packed_bytes = stream, packed_bytes
        self._left = max(_LEAST_FILE, _LARGEST_FILE_RATIO * packed_bytes)

    def __enter__(self) -> "_BoundedFile":
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        found = self._stream.read(size)
        self._left -= len(found)
        if self._left < 0:
            raise ValueError(f"a file of {self._packed_bytes:,} bytes unpacks to more than it may")
        return found


def _bounded(make: Callable[[], _Unpacker], what: str) -> Callable[..., bytes]:
    def unpack(packed: bytes, claimed: int | None = None) -> bytes:
        """``claimed`` is the size that MCAP's reader expects; that of ROS 1 passes none."""
        most = max(_LEAST_BOUND, _LARGEST_RATIO * len(packed))
        unpacker = make()
        found = unpacker.decompress(packed, most + 1 if claimed is None else min(most, claimed) + 1)
        if len(found) > most or (claimed is not None and (claimed > most or len(found) > claimed)):
            raise ValueError(f"a {what} of {len(packed):,} bytes claims to unpack to more than it may")
        if not unpacker.eof:
            raise ValueError(f"a packed {what} is cut short")
        return found

    return unpack


def _zstd() -> Any:
    try:
        return importlib.import_module("compression.zstd")  # from Python 3.14 on
    except ImportError:
        return importlib.import_module("backports.zstd")
