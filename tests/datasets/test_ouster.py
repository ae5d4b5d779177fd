"""Ouster's recordings: the geometry of their beams, poses, and what is said without ouster-sdk."""

import random
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from datasets_recordings import write_stamped
from numpy.typing import NDArray
from refusals import refused

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.lidar.ouster import NOMINAL_M, Beams
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.origins import starts_at
from taichi_mrf.sensor.ray_table import RayTable

ROWS, COLUMNS, N_M = 3, 32, 0.0277
ALTITUDE, AZIMUTH, SHIFTS = np.array([30.0, 0.0, -40.0]), np.array([11.0, -11.5, 1.0]), [2, 0, 1]
TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])


def metadata(sensor_height_m: float = 0.04) -> Any:
    """ouster-sdk's description of a sensor of three beams."""
    T_lidar_beam, T_sensor_lidar = np.eye(4), TURNED.copy()
    T_lidar_beam[0, 3], T_sensor_lidar[2, 3] = 1000 * N_M, 1000 * sensor_height_m
    return SimpleNamespace(
        beam_altitude_angles=ALTITUDE.tolist(),
        beam_azimuth_angles=AZIMUTH.tolist(),
        beam_to_lidar_transform=T_lidar_beam,
        lidar_to_sensor_transform=T_sensor_lidar,
        sensor_to_body=np.eye(4),
        format=SimpleNamespace(columns_per_frame=COLUMNS, pixel_shift_by_row=SHIFTS),
    )


def points(range_m: NDArray) -> NDArray:
    """Points (H, W, 3) by measurement in the lidar's frame, by Ouster's own formula."""
    encoder = 2 * np.pi * (1 - np.arange(COLUMNS) / COLUMNS)[None, :]
    azimuth, altitude = -np.radians(AZIMUTH)[:, None], np.radians(ALTITUDE)[:, None]
    along = range_m - N_M
    return np.stack(
        [
            along * np.cos(encoder + azimuth) * np.cos(altitude) + N_M * np.cos(encoder),
            along * np.sin(encoder + azimuth) * np.cos(altitude) + N_M * np.sin(encoder),
            along * np.sin(altitude) + 0 * encoder,
        ],
        axis=-1,
    )


@pytest.mark.parametrize(("range_m", "tolerance_m"), [(NOMINAL_M, 1e-4), (2.0, N_M), (2 * NOMINAL_M, N_M)])
def test_points_lie_where_the_maker_says(range_m: float, tolerance_m: float) -> None:
    beams, ranges = Beams.of(metadata()), np.full((ROWS, COLUMNS), range_m)
    distance_m = beams.from_centre(beams.shifted(ranges))
    found = beams.camera.rays() * distance_m[..., None]
    expected = np.stack([beams.shifted(axis) for axis in np.moveaxis(points(ranges), -1, 0)], axis=-1)
    assert np.linalg.norm(found - expected, axis=-1).max() < tolerance_m
    np.testing.assert_allclose(distance_m, np.linalg.norm(expected, axis=-1), rtol=1e-5)
    assert beams.T_sensor_lidar[2, 3] == 0.04


def test_no_measurement_stays_none() -> None:
    beams = Beams.of(metadata())
    assert not beams.from_centre(np.zeros((ROWS, COLUMNS))).any()


def test_a_sensor_that_does_not_spin_is_refused() -> None:
    info = metadata()
    info.beam_altitude_angles = np.zeros((ROWS, COLUMNS))
    with pytest.raises(DatasetError, match="does not spin"):
        Beams.of(info)


class Source:
    """A stand-in for what ouster.sdk.open_source returns: scans of 0.1 s, a tenth of a second apart."""

    def __init__(self, poses: list[NDArray], ranges_mm: NDArray | None = None) -> None:
        self.sensor_info = [metadata()]
        ranges = np.full((ROWS, COLUMNS), 5000, np.uint32) if ranges_mm is None else ranges_mm
        self.frames = [
            SimpleNamespace(
                status=np.ones(COLUMNS, np.uint32),
                timestamp=((10 + 0.1 * i + 0.1 * np.arange(COLUMNS) / (COLUMNS - 1)) * 1e9).astype(np.uint64),
                field=lambda name: ranges,
                body_to_world=pose,
                sensor_info=self.sensor_info[0],
            )
            for i, pose in enumerate(poses)
        ]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> list[Any]:
        return [self.frames[index]]


STILL = np.tile(np.eye(4), (COLUMNS, 1, 1))


def driving() -> NDArray:
    """Poses of the columns of a scan in which the sensor drives a metre along x."""
    poses = STILL.copy()
    poses[:, 0, 3] = np.linspace(0, 1, COLUMNS)
    return poses


@pytest.fixture
def played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> "Play":
    """An OSF file for which ouster-sdk gives a source; returns its path."""

    def play(source: object, data: bytes = WHOLE) -> Path:
        install(monkeypatch, source)
        (tmp_path / "walk.osf").write_bytes(data)
        return tmp_path / "walk.osf"

    return play


def osf(*names: bytes) -> bytes:
    """An OSF file of blocks with these names, which hold a few bytes."""
    blocks = (struct.pack("<II", 28, 20) + name + bytes(range(20)) for name in names)
    return b"".join(block + struct.pack("<I", zlib.crc32(block)) for block in blocks)


WHOLE = osf(b"OSF$", b"OSF!", b"OSF#")
Play = Callable[..., Path]


def install(monkeypatch: pytest.MonkeyPatch, source: object) -> None:
    def open_source(path: str, **more: object) -> object:
        if isinstance(source, Exception):
            raise source
        return source

    monkeypatch.setitem(sys.modules, "ouster", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "ouster.sdk", SimpleNamespace(open_source=open_source))


def test_a_sensor_that_stands_still_gives_images(played: Play) -> None:
    ranges = np.full((ROWS, COLUMNS), 5000, np.uint32)
    ranges[1, 4] = 0
    dataset = open_dataset(played(Source([STILL, STILL], ranges)))
    frame = dataset.read(1)
    assert (len(dataset), frame.name, dataset.stated.reach_m) == (2, "000001", 10.0)
    assert frame.camera == dataset.camera
    assert np.argwhere(frame.no_return).tolist() == [[1, 4 + SHIFTS[1]]]
    np.testing.assert_allclose(frame.T_world_camera[:3, :3], TURNED[:3, :3])
    assert frame.stamp == pytest.approx(10.15)
    assert any("assumed to stand still" in note for note in dataset.notes)


def test_columns_start_where_the_sensor_was(played: Play) -> None:
    recording = played(Source([driving()]))
    frame = open_dataset(recording).read(0)
    T, camera = frame.T_world_camera, frame.camera
    assert isinstance(camera, RayTable)
    assert camera.has_pattern
    assert frame.depth_m.shape == (ROWS, COLUMNS + max(SHIFTS)), "no row has a seam inside"
    expected = points(np.full((ROWS, COLUMNS), 5.0)) @ TURNED[:3, :3].T + [0, 0, 0.04]
    expected += driving()[None, :, :3, 3]
    found = frame.points_m @ T[:3, :3].T + T[:3, 3]
    assert not frame.no_return.any()
    for row, shift in enumerate(SHIFTS):
        own = slice(shift, shift + COLUMNS)
        assert (frame.depth_m[row] > 0).sum() == (frame.depth_m[row, own] > 0).sum() == COLUMNS
        assert np.linalg.norm(found[row, own] - expected[row], axis=-1).max() < N_M
        starts = starts_at(camera, np.arange(COLUMNS) + shift, row) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(starts, driving()[:, :3, 3] + [0, 0, 0.04], atol=2e-3)
    rigid = open_dataset(f"{recording}?deskew=false").read(0)
    assert rigid.no_return is not None
    np.testing.assert_allclose(rigid.T_world_camera[:3, 3], [0.5, 0, 0.04], atol=1e-6)


def test_poses_of_a_file(played: Play, tmp_path: Path) -> None:
    recording = played(Source([STILL, STILL, STILL]))
    T = look_at([1.0, 2.0, 3.0], [4.0, 2.0, 3.0])
    poses = write_stamped(tmp_path / "poses.txt", (10.0, 10.1, 10.2), [T] * 3)
    dataset = open_dataset(f"{recording}?poses={poses}")
    assert (len(dataset), dataset.dropped) == (2, 1)
    expected = T @ Beams.of(metadata()).T_sensor_lidar
    np.testing.assert_allclose(dataset.read(0).T_world_camera, expected, atol=1e-6)
    assert open_dataset(f"{recording}?poses=track").tracked


def test_a_scan_that_poses_of_a_file_cover_in_part_is_left_out(played: Play, tmp_path: Path) -> None:
    recording = played(Source([STILL] * 5))

    def opened(times: NDArray, query: str = "") -> Dataset:
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, 0, 3] = 10.0 * (times - 10.0)
        return open_dataset(f"{recording}?poses={write_stamped(tmp_path / 'walk.txt', times, poses)}{query}")

    late = np.arange(1004, 1054, 2) / 100  # from within the first scan on
    dataset = opened(late)
    assert (dataset.frame_names, dataset.dropped) == ([f"{i:06d}" for i in range(1, 5)], 1)
    assert any(note.startswith("1 of 5 scans dropped: none has poses") for note in dataset.notes)
    assert all(frame.camera.origins_m is not None for frame in dataset)
    assert len(opened(late, "&deskew=false")) == 5
    holed = opened(late[(late < 10.07) | (late > 10.32)])  # 0.28 s: more than twice the gap
    assert (holed.frame_names, holed.dropped) == (["000004"], 4)
    middles = open_dataset(recording).stamps()
    alone = opened(np.array([middles[0], middles[0] + 5]))
    assert (len(alone), alone.dropped) == (1, 4)
    assert any("the lidar's motion in a scan is not undone" in note for note in alone.notes)


@pytest.mark.parametrize(
    ("source", "query", "problem"),
    [
        (RuntimeError("no metadata"), "", "cannot be read: no metadata"),
        (Source([]), "", "none of its 0 scans can be read"),
        (Source([STILL]), "?sensor=1", "has 1 sensors, so there is no sensor 1"),
        (Source([STILL]), "?sensors=1", "unknown parameter 'sensors'"),
    ],
)
def test_what_cannot_be_opened_is_named(played: Play, source: object, query: str, problem: str) -> None:
    recording = played(source)
    refused(f"{recording}{query}", str(recording), problem)


def test_the_reach_is_that_of_the_first_scan_with_returns(played: Play) -> None:
    source = Source([STILL, STILL])
    source.frames[0].field = lambda name: np.zeros((ROWS, COLUMNS), np.uint32)
    source.frames[1].field = lambda name: np.full((ROWS, COLUMNS), 23_000, np.uint32)
    assert open_dataset(played(source)).stated.reach_m == 30.0


def test_a_sensor_that_moves_between_scans_does_not_stand_still(played: Play) -> None:
    moved = STILL.copy()
    moved[:, 0, 3] = 2.0
    dataset = open_dataset(played(Source([STILL, moved])))
    assert not any("stand still" in note for note in dataset.notes)


def test_a_scan_without_returns_says_so(played: Play) -> None:
    source = Source([STILL, STILL])
    dataset = open_dataset(played(source))
    source.frames[1].field = lambda name: np.zeros((ROWS, COLUMNS), np.uint32)
    source.frames[1].status = np.arange(COLUMNS, dtype=np.uint32) % 2
    frame = dataset.read(1)
    assert not frame.depth_m.any()
    assert frame.no_return.mean() == 0.5


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "is empty"),
        (b"scans", "not an OSF file"),
        (b"x" * 100, "not an OSF file"),
        (osf(b"OSF$", b"OSF!"), "is cut short: its metadata are missing"),
        (WHOLE[:-1], "is cut short or damaged: 28 bytes at byte 72 do not fit"),
        (WHOLE[:80], "is cut short at byte 80"),
        (WHOLE[:36] + b"\xff\xff\xff\xff" + WHOLE[40:], "4,294,967,295 bytes at byte 36 do not fit"),
        (WHOLE[:36] + bytes(4) + WHOLE[40:], "is cut short or damaged: 0 bytes at byte 36"),
        *(
            (WHOLE[:i] + bytes([WHOLE[i] ^ 4]) + WHOLE[i + 1 :], "checksum of the block")
            for i in (20, 50, 71, 107)
        ),
    ],
)
def test_a_damaged_osf_is_refused_before_the_library_reads_it(
    played: Play, data: bytes, problem: str
) -> None:
    recording = played(AssertionError("the library read it"), data)
    assert refused(recording, problem).startswith(f"{recording}: ")


def pcap(*sizes: tuple[int, int], order: str = "<") -> bytes:
    """Packets of these sizes, captured and sent."""
    head = struct.pack(f"{order}IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    return head + b"".join(struct.pack(f"{order}IIII", 1, 2, *size) + bytes(size[0]) for size in sizes)


@pytest.mark.parametrize("order", ["<", ">"])
def test_packets_that_are_cut_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: str) -> None:
    install(monkeypatch, Source([STILL]))
    path = tmp_path / "walk.pcap"
    whole = pcap((90, 90), (60, 60), order=order)
    path.write_bytes(whole)
    assert len(open_dataset(path)) == 1
    for data, problem in (
        (b"", "is empty"),
        (whole[:-1], "is cut short in packet 1"),
        (whole[:135], "is cut short in packet 1"),
        (pcap((90, 90), (42, 60), order=order), "packet 1 holds 42 of its 60 bytes"),
    ):
        path.write_bytes(data)
        refused(path, problem)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "cut short": lambda data: data[: len(data) // 2],
    "noise": lambda data: random.Random(0).randbytes(5000),
    "no header": lambda data: bytes(100) + data[100:],
    "a stretch of ones": lambda data: data[:3000] + b"\xff" * 500 + data[3500:],
    "a bit": lambda data: data[:-50] + bytes([data[-50] ^ 1]) + data[-49:],
}


@pytest.mark.shared_data
@pytest.mark.parametrize("suffix", [".osf", ".pcap", ".json"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_real_recordings_that_are_damaged(
    shared_data: Path, tmp_path: Path, suffix: str, damage: str
) -> None:
    """ouster-sdk ends the process on more than half of all damaged OSF files."""
    pytest.importorskip("ouster.sdk", reason="reading real recordings needs ouster-sdk")
    folder, stem = shared_data / "ouster", "OS-0-128-U1_v2.3.0_1024x10"
    sources = [folder / "osf_fw_3.2_10scans.osf", folder / f"{stem}.pcap", folder / f"{stem}.json"]
    for source in sources:
        data = source.read_bytes()
        (tmp_path / source.name).write_bytes(DAMAGES[damage](data) if source.suffix == suffix else data)
    path = tmp_path / (sources[0].name if suffix == ".osf" else f"{stem}.pcap")
    said = None
    try:
        dataset = open_dataset(path)
        for index in range(len(dataset)):
            dataset.read(index)
    except DatasetError as error:
        said = str(error)
    if said is not None:
        assert str(path) in said
        assert "\n" not in said
    else:  # packets that are damaged are left out, and some words of the metadata do not count
        assert suffix != ".osf"
        assert damage in ("cut short", "a stretch of ones", "a bit")


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "count", "shape"),
    [
        ("OS-1-128_v2.3.0_1024x10_lb_n3.osf", 3, (128, 1024)),
        ("osf_fw_3.2_10scans.osf", 10, (8, 2048)),
        ("OS-0-128-U1_v2.3.0_1024x10.pcap", 1, (128, 1024)),
    ],
)
def test_real_recordings(shared_data: Path, name: str, count: int, shape: tuple[int, int]) -> None:
    """The points are those that ouster-sdk computes."""
    sdk = pytest.importorskip("ouster.sdk", reason="reading real recordings needs ouster-sdk")
    from ouster.sdk import core

    path = shared_data / "ouster" / name
    dataset = open_dataset(path)
    frame = dataset.read(0)
    assert (len(dataset), frame.depth_m.shape) == (count, shape)
    source = sdk.open_source(str(path), index=True)
    info, scan = source.sensor_info[0], next(iter(source[0]))
    expected = core.destagger(info, core.XYZLut(info, False)(scan))
    seen = frame.depth_m > 0
    found = frame.camera.rays() * frame.depth_m[..., None]
    T = Beams.of(info).T_sensor_lidar
    error = np.linalg.norm(found @ T[:3, :3].T + T[:3, 3] - expected, axis=-1)[seen]
    assert seen.mean() > 0.3
    assert np.median(error) < 0.01
    assert error.max() < 0.03
