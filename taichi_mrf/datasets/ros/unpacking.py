"""Bounds on what a bag's packed chunks unpack to.

rosbags unpacks a chunk to whatever it holds, which for a file of 65 kB may be gigabytes. Its readers look the
unpackers up in tables; :func:`bound_chunks` puts bounded ones there.
"""

import bz2
import importlib
from collections.abc import Callable
from typing import Any, Protocol

_LEAST_BOUND, _LARGEST_RATIO = 1 << 26, 1000
"""Chunks are a few megabytes, and one large image at most; images of a single value pack a thousandfold."""


class _Unpacker(Protocol):
    @property
    def eof(self) -> bool: ...

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def bound_chunks() -> None:
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
            table[name] = _bounded(unpackers[name])


def _bounded(make: Callable[[], _Unpacker]) -> Callable[..., bytes]:
    def unpack(packed: bytes, claimed: int | None = None) -> bytes:
        """MCAP's reader says how much there should be, that of ROS 1 does not."""
        most = max(_LEAST_BOUND, _LARGEST_RATIO * len(packed))
        unpacker = make()
        found = unpacker.decompress(packed, most + 1 if claimed is None else min(most, claimed) + 1)
        if len(found) > most or (claimed is not None and (claimed > most or len(found) > claimed)):
            raise ValueError(f"a chunk of {len(packed):,} bytes claims to unpack to more than it may")
        if not unpacker.eof:
            raise ValueError("a packed chunk is cut short")
        return found

    return unpack


def _zstd() -> Any:
    try:
        return importlib.import_module("compression.zstd")  # from Python 3.14 on
    except ImportError:
        return importlib.import_module("backports.zstd")
