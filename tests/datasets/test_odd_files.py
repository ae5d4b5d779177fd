"""Sources that are no regular files, whose names are too long, or that claim far more than they hold."""

import bz2
import os
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import lz4.frame
import numpy as np
import pytest
from datasets_recordings import Content, write_image, write_seven_scenes
from inputs_bags import Bag, plain, write_bag
from refusals import bad_frame, refused
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import StoragePlugin, storage_mcap
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

from taichi_mrf.calibration.pairs import DepthFiles
from taichi_mrf.config.schema import load
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.images import claimed_size, read_color, read_depth, read_grey
from taichi_mrf.datasets.laser.readers import open_scans
from taichi_mrf.datasets.ros import reader as tolerance
from taichi_mrf.datasets.ros.reader import bound_unpacking
from taichi_mrf.datasets.trajectories import read_trajectory
from taichi_mrf.errors import DatasetError, FrameError, TaichiMRFError
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.sensor.noise import PatchNoise
from taichi_mrf.system import packed

OPENERS: list[tuple[Callable[[Path], object], str]] = [
    (open_dataset, ".npz"),
    (open_dataset, ".mcap"),
    (open_dataset, ".r3d"),
    (open_dataset, ".yaml"),
    (open_scans, ".log"),
    (open_scans, ".npz"),
    (load_map, ".npz"),
    (load, ".yaml"),
    (read_octomap, ".bt"),
    (read_trajectory, ".txt"),
    (PatchNoise.load, ".npz"),
    (read_grey, ".png"),
    (lambda path: DepthFiles(path, 1000.0), ".npy"),
    (ChunkedMap.open, ".zarr"),
]
LARGE = (30_000, 30_000)


@pytest.mark.skipif(os.name == "nt", reason="FIFOs and devices in the file system are a POSIX feature")
@pytest.mark.parametrize(("opener", "suffix"), OPENERS)
def test_no_reader_waits_for_a_fifo_or_reads_an_endless_device(
    tmp_path: Path, opener: Callable[[Path], object], suffix: str
) -> None:
    fifo, link = tmp_path / f"fifo{suffix}", tmp_path / f"link{suffix}"
    os.mkfifo(fifo)
    link.symlink_to("/dev/zero")
    for path in (fifo, link):
        with pytest.raises(TaichiMRFError, match=path.name):
            opener(path)


@pytest.mark.parametrize(("opener", "suffix"), OPENERS)
def test_a_path_that_is_too_long_is_our_error(opener: Callable[[Path], object], suffix: str) -> None:
    with pytest.raises(TaichiMRFError, match=suffix):
        opener(Path("x" * 5000 + suffix))


@pytest.mark.skipif(os.name == "nt", reason="FIFOs are a POSIX feature")
@pytest.mark.parametrize("file", ["depth.png", "color.png", "pose.txt"])
def test_a_fifo_in_a_recording_is_a_bad_frame(tmp_path: Path, file: str) -> None:
    folder = write_seven_scenes(tmp_path, Content(2))
    path = folder / f"frame-000000.{file}"
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    dataset = open_dataset(folder)
    if file == "color.png":  # colour is optional: what is no file is none
        assert dataset.read(0).color is None
        return
    with pytest.raises(FrameError, match=rf"frame-000000\.{file}.*(a FIFO|is missing)"):
        dataset.read(0)


@pytest.mark.skipif(os.name == "nt", reason="FIFOs are a POSIX feature")
def test_a_fifo_in_a_bag_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path, plain, kind="mcap")
    file = next(path.glob("*.mcap"))
    file.unlink()
    os.mkfifo(file)
    refused(tmp_path / "walk", ".mcap: cannot be read: it is a FIFO")


def png_of_zeros(width: int, height: int) -> bytes:
    """A 16-bit grey PNG whose pixels are packed a thousandfold."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, packed = zlib.compressobj(9), []
    row = bytes(1 + 2 * width)
    packed = [packer.compress(row) for _ in range(height)]
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    pixels = b"".join([*packed, packer.flush()])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


@pytest.fixture
def nothing_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("an image was unpacked before its size was looked at")

    monkeypatch.setattr("taichi_mrf.datasets.images.cv2.imdecode", fail)
    monkeypatch.setattr("taichi_mrf.datasets.images._png_damage", fail)


def test_an_image_of_another_size_than_the_cameras_is_refused_by_its_header(
    tmp_path: Path, nothing_is_unpacked: None
) -> None:
    folder = write_seven_scenes(tmp_path, Content(1))
    (folder / "frame-000000.depth.png").write_bytes(png_of_zeros(2000, 1000))
    bad_frame(open_dataset(folder), 0, "the image has 2000 x 1000 pixels, the camera")


def bmp(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHHIIiiII", 200, 0, 54, 40, width, -height, 1, 24, 0, 0, 1, 1, 0, 0)


def tiff(order: str, width: int, height: int, *more: tuple[int, int]) -> bytes:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    entries = [(256, width), (257, height), *more]
    head = mark + struct.pack(f"{order}IH", 8, len(entries))
    return head + b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in entries)


def webp(kind: bytes, data: bytes) -> bytes:
    return b"RIFF\0\0\0\0WEBP" + kind + struct.pack("<I", len(data)) + data


LARGE_FILES = {
    "png": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", *LARGE), "30000 x 30000"),
    "jpg": (
        b"\xff\xd8\xff\xe0" + struct.pack(">H", 16) + bytes(14)
        + b"\xff\xc0" + struct.pack(">HBHH", 17, 8, *LARGE),
        "30000 x 30000",
    ),
    "bmp": (bmp(*LARGE), "30000 x 30000"),
    "pgm": (b"P5\n# made by hand\n30000 30000\n65535\n", "30000 x 30000"),
    "ppm": (b"P6 30000 30000 255 ", "30000 x 30000"),
    "tiff": (tiff("<", *LARGE), "30000 x 30000"),
    "tiff of Motorola": (tiff(">", *LARGE), "30000 x 30000"),
    "tiff with one large tile": (tiff("<", 64, 48, (322, 1 << 20), (323, 1 << 20)), "1048576 x 1048576"),
    "webp": (webp(b"VP8X", bytes(4) + (29_999).to_bytes(3, "little") * 2), "30000 x 30000"),
    "webp, lossless": (webp(b"VP8L", b"\x2f" + struct.pack("<I", 16_382 << 14 | 16_382)), "16383 x 16383"),
    "webp, lossy": (
        webp(b"VP8 ", b"\0\0\0\x9d\x01\x2a" + struct.pack("<HH", 16_383, 16_383)),
        "16383 x 16383",
    ),
}  # fmt: skip


@pytest.mark.parametrize("read", [lambda path: read_depth(path, 1000.0), read_color, read_grey])
@pytest.mark.parametrize(("data", "size"), LARGE_FILES.values(), ids=LARGE_FILES)
def test_images_that_claim_too_many_pixels_are_refused_by_their_header(
    tmp_path: Path, nothing_is_unpacked: None, read: Callable[[Path], object], data: bytes, size: str
) -> None:
    path = tmp_path / "large"
    path.write_bytes(data + bytes(100))
    with pytest.raises(DatasetError, match=f"{size} pixels; at most 134,217,728 are read"):
        read(path)


OTHER_FILES = {
    "OpenEXR": b"\x76\x2f\x31\x01",
    "Radiance": b"#?RADIANCE\n",
    "JPEG 2000": b"\0\0\0\x0cjP  \r\n\x87\n",
    "GIF": b"GIF89a",
    "PFM": b"Pf\n4 4\n-1.0\n",
    "Sun": b"\x59\xa6\x6a\x95",
    "TIFF with more than 4 GB": b"II\x2b\0\x08\0\0\0",
    "TIFF without a size": tiff("<", 0, 0)[:10],
    "JPEG without a size": b"\xff\xd8\xff\xd9",
}


@pytest.mark.parametrize("data", OTHER_FILES.values(), ids=OTHER_FILES)
def test_images_whose_size_cannot_be_read_first_are_not_decoded(
    tmp_path: Path, nothing_is_unpacked: None, data: bytes
) -> None:
    path = tmp_path / "image"
    path.write_bytes(data + bytes(100))
    with pytest.raises(DatasetError, match=r"not a readable image \(no PNG, JPEG, TIFF"):
        read_grey(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".webp", ".pgm", ".ppm"])
def test_the_size_that_a_header_claims_is_that_of_the_image(tmp_path: Path, suffix: str) -> None:
    image = np.full((12, 16, 3) if suffix != ".pgm" else (12, 16), 99, np.uint8)
    path = write_image(tmp_path / f"a{suffix}", image)
    assert claimed_size(path.read_bytes()) == (16, 12)
    assert read_color(path).shape == (12, 16, 3)


@pytest.mark.parametrize("suffix", [".tiff", ".pgm"])
def test_depth_images_of_other_formats_are_read(tmp_path: Path, suffix: str) -> None:
    path = write_image(tmp_path / f"a{suffix}", np.full((12, 16), 1500, np.uint16))
    np.testing.assert_array_equal(read_depth(path, 1000.0), 1.5)


@pytest.mark.parametrize("steps_per_metre", [1000.0, 5000.0])
def test_every_number_of_16_bits_is_its_depth_but_the_largest(tmp_path: Path, steps_per_metre: float) -> None:
    steps = np.arange(1 << 16, dtype=np.uint16).reshape(256, 256)
    path = tmp_path / "all.png"
    assert cv2.imwrite(str(path), steps)
    expected = steps.astype(np.float32) / np.float32(steps_per_metre)
    expected[-1, -1] = 0
    first = read_depth(path, steps_per_metre)
    np.testing.assert_array_equal(first, expected)
    first[:] = -1  # an image of its own, not the table
    np.testing.assert_array_equal(read_depth(path, steps_per_metre), expected)


def packed_zeros(codec: str, size: int) -> bytes:
    pack: dict[str, Callable[[bytes], bytes]] = {
        "bz2": bz2.compress,
        "lz4": lz4.frame.compress,
        "zstd": storage_mcap.zstd.compress,
    }
    return pack[codec](bytes(size))


def test_a_chunk_of_an_mcap_that_unpacks_to_more_than_it_says_is_refused(tmp_path: Path) -> None:
    bomb = packed_zeros("zstd", 300_000_000)
    assert len(bomb) < 10_000
    writer: Any = Writer2(tmp_path / "walk", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        plain(Bag("mcap", writer))
        writer.storage.compressor = lambda data: bomb
    with pytest.raises(DatasetError, match=r"walk.*claims to unpack to more than it may"):
        open_dataset(tmp_path / "walk").read(0)


@pytest.mark.parametrize("codec", ["bz2", "lz4", "zstd"])
def test_unpackers_are_bounded_and_give_what_is_packed(codec: str) -> None:
    bound_unpacking()
    with_size = (1_000_000,)
    calls = [(storage_mcap.DECOMPRESSORS, with_size), (rosbag1.decompressors, ())]
    found = [(table[codec], size) for table, size in calls if codec in table]
    assert found
    for unpack, size in found:
        packed = packed_zeros(codec, 1_000_000)
        assert unpack(packed, *size) == bytes(1_000_000)
        with pytest.raises((ValueError, EOFError), match=r"cut short"):
            unpack(packed[:-5], *size)


@pytest.mark.parametrize(
    ("codec", "claimed"), [("bz2", ()), ("zstd", (1000,)), ("zstd", (100_000_000,)), ("lz4", (1000,))]
)
def test_nothing_is_unpacked_beyond_what_is_claimed_or_likely(codec: str, claimed: tuple[int, ...]) -> None:
    bound_unpacking()
    table = storage_mcap.DECOMPRESSORS if claimed else rosbag1.decompressors
    with pytest.raises(ValueError, match="unpack to more than it may"):
        table[codec](packed_zeros(codec, 100_000_000), *claimed)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE])
def test_bags_with_compressed_messages_or_files_are_read_and_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, storage: StoragePlugin, mode: CompressionMode
) -> None:
    writer: Any = Writer2(tmp_path / "walk", version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        plain(Bag("mcap" if storage is StoragePlugin.MCAP else "db3", writer))
    assert len(open_dataset(tmp_path / "walk")) > 0
    for name in ("_LEAST_BOUND", "LARGEST_RATIO"):
        monkeypatch.setattr(tolerance, name, 1)
    for name in ("LEAST_BYTES", "LARGEST_RATIO"):
        monkeypatch.setattr(packed, name, 1)
    what = "message" if mode is CompressionMode.MESSAGE else "file"
    with pytest.raises(DatasetError, match=f"{what} of .* may|too much for a file"):
        open_dataset(tmp_path / "walk").read(0)


def test_texts_in_a_png_are_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A megabyte of them takes seconds, at each image."""
    image = np.arange(12, dtype=np.uint16).reshape(3, 4)
    plain = cv2.imencode(".png", image)[1].tobytes()
    texts = b"".join(
        struct.pack(">I", len(text)) + kind + text + struct.pack(">I", zlib.crc32(kind + text))
        for kind in (b"tEXt", b"zTXt", b"iTXt", b"iCCP")
        for text in [b"a\0\0" + zlib.compress(bytes(1000))]
    )
    path, given, decode = tmp_path / "texts.png", [], cv2.imdecode
    path.write_bytes(plain[:33] + texts + plain[33:])  # after the header

    def spied(data: np.ndarray, flags: int) -> np.ndarray:
        given.append(data.tobytes())
        return decode(data, flags)

    monkeypatch.setattr(cv2, "imdecode", spied)
    np.testing.assert_array_equal(read_depth(path, 1.0), image)
    assert given == [plain]


@pytest.mark.parametrize(
    "made", ["VIEW schema AS SELECT 4 AS schema_version", "TABLE other (a, b AS (zeroblob(900000000)))"]
)
def test_a_bag_whose_rows_are_computed_is_refused(tmp_path: Path, made: str) -> None:
    path = tmp_path / "walk"
    writer: Any = Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    with writer:
        plain(Bag("db3", writer))
    assert len(open_dataset(path)) > 0
    with sqlite3.connect(path / "walk.db3") as connection:
        connection.execute("DROP TABLE IF EXISTS schema")
        connection.execute(f"CREATE {made}")
    connection.close()
    with pytest.raises(
        DatasetError, match=r"walk: .*(schema is not a table|other has columns that are comp)"
    ):
        open_dataset(path)
