"""Bags whose chunks unpack to far more than they take are refused before the memory is taken."""

import bz2
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from inputs_bags import Bag
from new_interpreter import python
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode


def zeros(bag: Bag, count: int, size: int) -> None:
    """Images of zeros, each in a chunk of its own."""
    connection = bag.writer.add_connection("/depth", "sensor_msgs/msg/Image", typestore=bag.types)
    for number in range(count):
        bag.writer.write(connection, 10**9 + number, bytes(size))


def chunks_of_zeros(folder: Path) -> Path:
    """Five of 60 MB, each of which could be an image."""
    writer = Writer1(folder / "walk.bag")
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    with writer:
        zeros(Bag("ros1", writer), 5, 60_000_000)
    return folder / "walk.bag"


def one_of_more_than_its_header_says(folder: Path) -> Path:
    """Half a gigabyte that packs 600 times."""
    writer: Any = Writer1(folder / "walk.bag")
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    with writer:
        writer.compressor = lambda _: bz2.compress(os.urandom(800_000) + bytes(500_000_000))
        zeros(Bag("ros1", writer), 1, 10)
    return folder / "walk.bag"


def one_that_the_index_lists_sixty_times(folder: Path) -> Path:
    """48 MB of zeros. rosbags holds all chunks at once whose times overlap."""
    writer: Any = Writer2(folder / "walk", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        zeros(Bag("mcap", writer), 1, 48_000_000)
        writer.storage.chunks *= 60
    return folder / "walk" / "walk.mcap"


INFO = """
import atexit, runpy, sys
from pathlib import Path
atexit.register(lambda: print(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]))
sys.argv[1:] = ["info", {path!r}]
runpy.run_module("taichi_mrf", run_name="__main__")
"""
"""`taichi-mrf info`, and the most memory that it took, in KB."""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak of a process's memory is read from /proc")
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (chunks_of_zeros, "unpacks to 0.3 GB, too much for a file of"),
        (one_of_more_than_its_header_says, "claims to unpack to more than it may"),
        (one_that_the_index_lists_sixty_times, "unpacks to 2.88 GB, too much for a file of"),
    ],
)
def test_chunks_that_unpack_to_too_much_take_no_memory(tmp_path: Path, make: Any, words: str) -> None:
    python("-c", "")  # --quick leaves the test out here, before half a gigabyte is packed
    path = make(tmp_path)
    done = python("-c", INFO.format(path=str(path)))
    assert done.returncode == 2
    assert done.stderr.startswith(f"taichi-mrf: {path}: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert int(done.stdout.split()[-1]) < 300_000
