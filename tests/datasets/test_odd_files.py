"""Sources that are no regular files, whose names are too long, or that claim far more than they hold."""

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import Content, write_image, write_seven_scenes
from inputs_bags import plain, writing

from taichi_mrf.calibration.depth_files import DepthFiles
from taichi_mrf.config.schema import load
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.images import read_color, read_depth, read_grey
from taichi_mrf.datasets.laser.readers import open_scans
from taichi_mrf.datasets.trajectories import read_trajectory
from taichi_mrf.errors import DatasetError, FrameError, TaichiMRFError
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.sensor.noise import PatchNoise

OPENERS: list[tuple[Callable[[Path], object], str]] = [
    (open_dataset, ".npz"),
    (open_dataset, ".mcap"),
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
    with writing(tmp_path / "walk", "mcap") as bag:
        plain(bag)
    file = next((tmp_path / "walk").glob("*.mcap"))
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(DatasetError, match=r"\.mcap: cannot be read: it is a FIFO"):
        open_dataset(tmp_path / "walk")


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
    with pytest.raises(FrameError, match="the image has 2000 x 1000 pixels, the camera"):
        open_dataset(folder).read(0)


@pytest.mark.parametrize("read", [lambda path: read_depth(path, 1000.0), read_color, read_grey])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_image_that_claims_too_many_pixels_is_refused_by_its_header(
    tmp_path: Path, nothing_is_unpacked: None, read: Callable[[Path], object], suffix: str
) -> None:
    path = tmp_path / f"large{suffix}"
    if suffix == ".png":
        path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", *LARGE) + bytes(100))
    else:
        path.write_bytes(
            b"\xff\xd8\xff\xe0" + struct.pack(">H", 16) + bytes(14)
            + b"\xff\xc0" + struct.pack(">HBHH", 17, 8, *LARGE) + bytes(100)
        )  # fmt: skip
    with pytest.raises(DatasetError, match="30000 x 30000 pixels; at most 134,217,728 are read"):
        read(path)


def test_a_jpeg_of_the_cameras_size_is_read(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.jpg", np.full((12, 16, 3), 99, np.uint8))
    assert read_color(path).shape == (12, 16, 3)
