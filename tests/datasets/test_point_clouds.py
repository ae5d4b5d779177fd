"""Point clouds in files: PCD of three encodings, PLY, npz and KITTI's, whole and damaged."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from console import carry_out
from datasets_recordings import row_of, write_rows
from hypothesis import given, settings
from hypothesis import strategies as st
from point_clouds import LasFile, Points, RoomWalk, Walk, las_head, lzf, write_pcd, write_ply
from refusals import refusal, refused

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.lidar.clouds import (
    is_cloud,
    read_cloud,
    read_pcd,
    read_ply_points,
    unpack_lzf,
)
from taichi_mrf.datasets.recording import natural
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, look_at

POINTS = np.vstack([Walk(1).clouds[0], [[0, 0, 0], [np.nan, 1, 2]]]).astype(np.float32)
ENCODINGS = ("ascii", "binary", "binary_compressed")
PLY_ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
T = look_at([1.0, 2.0, 3.0], [4.0, 4.0, 3.5])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_pcd(tmp_path: Path, encoding: str) -> None:
    points, T_world_sensor = read_pcd(write_pcd(tmp_path / "a.pcd", POINTS, encoding, T))
    np.testing.assert_array_equal(points.astype(np.float32), POINTS)
    np.testing.assert_allclose(T_world_sensor, T, atol=1e-8)


@pytest.mark.parametrize("encoding", PLY_ENCODINGS)
def test_ply(tmp_path: Path, encoding: str) -> None:
    points = read_ply_points(write_ply(tmp_path / "a.ply", POINTS, encoding))
    np.testing.assert_array_equal(points.astype(np.float32), POINTS)


def test_npz_in_metres_and_in_steps(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", intensity=np.ones(3), xyz=POINTS)
    np.savez(tmp_path / "b.npz", xyz_5mm=np.array([[200, -400, 0]], np.int16))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npz"), POINTS)
    np.testing.assert_allclose(read_cloud(tmp_path / "b.npz"), [[1.0, -2.0, 0.0]])


def test_velodyne(tmp_path: Path) -> None:
    np.column_stack([POINTS, np.ones(len(POINTS))]).astype("<f4").tofile(tmp_path / "0.bin")
    np.testing.assert_array_equal(read_cloud(tmp_path / "0.bin"), POINTS)
    (tmp_path / "1.bin").write_bytes(bytes(17))
    with pytest.raises(DatasetError, match=r"1\.bin: has 17 bytes, not a whole number of points"):
        read_cloud(tmp_path / "1.bin")


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
def test_numbers_of_a_point_are_found_by_what_fits(tmp_path: Path, columns: int) -> None:
    """In a room, with reflectance, ring and time. The size of 960 points fits all numbers of columns."""
    random = np.random.default_rng(columns)
    points = random.uniform([-3, -2, -1], [3, 2, 1.5], (960, 3))
    more = [random.uniform(0, 1, 960), np.arange(960) % 24, np.linspace(0, 0.1, 960)]
    table = np.column_stack([points, *more])[:, :columns].astype("<f4")
    table.tofile(tmp_path / "0.bin")
    np.testing.assert_array_equal(read_cloud(tmp_path / "0.bin"), table[:, :3])


@pytest.mark.parametrize("columns", [3, 4, 5])
def test_numbers_of_a_point_are_a_note_of_the_recording_and_no_warning_of_its_scans(
    tmp_path: Path, recwarn: pytest.WarningsRecorder, columns: int
) -> None:
    random = np.random.default_rng(0)
    for scan in range(2):
        table = [random.uniform([-3, -2, -1], [3, 2, 1.5], (960, 3)), np.full(960, 12.0), np.arange(960) % 24]
        np.column_stack(table)[:, :columns].astype("<f4").tofile(tmp_path / f"{scan}.bin")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    dataset = open_dataset(tmp_path)
    said = f".bin files with {columns} numbers a point, of which the first are x y z"
    assert dataset.notes.count(said) == (columns != 4)
    assert len(list(dataset)) == 2
    assert [str(each.message) for each in recwarn] == []


@settings(max_examples=30, deadline=None)
@given(st.binary(max_size=400), st.integers(1, 60))
def test_lzf_gives_back_what_was_packed(data: bytes, times: int) -> None:
    data = data + data[:7] * times
    assert unpack_lzf(lzf(data), len(data)) == data


@pytest.mark.parametrize(
    ("packed", "size", "problem"),
    [
        (b"\x05abc", 6, "ends within a run"),
        (b"\x00a\xe0", 9, "ends within a repeat"),
        (b"\x00a\x20\x07", 4, "begins before the first byte"),
        (b"\x02abc", 9, "fewer than 9"),
        (b"\x02abc", 2, "more than 2"),
    ],
)
def test_damaged_lzf_is_refused(packed: bytes, size: int, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        unpack_lzf(packed, size)


WRONG_HEADERS: list[tuple[Callable[..., Path], bytes, bytes, str]] = [
    *(
        (write_pcd, old, new, problem)
        for old, new, problem in (
            (b"DATA binary", b"DATA packed", "DATA 'packed' is not ascii"),
            (b"DATA binary\n", b"", "no DATA entry"),
            (b"FIELDS x y intensity _ z", b"FIELDS x y intensity _ w", "FIELDS has no z"),
            (b"SIZE 4 4 2 1 4", b"SIZE 4 4 2 1", "have 5, 4, 5 and 5 entries"),
            (b"SIZE 4 4 2 1 4", b"SIZE 4 4 2 1 3", "field 'z' of TYPE F and SIZE 3 is not known"),
            (b"COUNT 1 1 1 3 1", b"COUNT 1 1 1 0 1", "COUNT 0"),
            (b"WIDTH 42", b"WIDTH 41", "POINTS is 42, WIDTH x HEIGHT 41"),
            (b"WIDTH 42", b"WIDTH wide", "WIDTH 'wide' is not a whole number"),
            (b"HEIGHT 1", b"HEIGHT -1", "must not be negative"),
            (b"VIEWPOINT 0 0 0 1", b"VIEWPOINT 0 0 0 0", "VIEWPOINT: the quaternion of a pose is zero"),
            (b"VIEWPOINT 0 0", b"VIEWPOINT 0", "has 6 numbers"),
            (b"VIEWPOINT 0", b"VIEWPOINT nowhere", "not a number"),
        )
    ),
    *(
        (write_ply, old, new, problem)
        for old, new, problem in (
            (b"ply\n", b"plywood\n", "not a PLY file"),
            (b"end_header", b"the end", "not a PLY file, or its header has no end"),
            (b"format binary_little_endian", b"format morse", "format 'morse' is not one of"),
            (b"property double y", b"property double w", "no property y"),
            (b"property float z", b"property list uchar float z", "is not one number"),
            (b"property float z", b"property double x", "is not one number"),
            (b"element vertex 42", b"element vertex many", "'many' is not a number of elements"),
            (b"element vertex 42", b"element vertex " + b"9" * 5000, "9' is not a number of elements"),
            (b"element vertex 42", b"element vertex", "is cut short"),
            (b"element vertex", b"element camera", "first element is not the vertex"),
        )
    ),
]


@pytest.mark.parametrize(("write", "old", "new", "problem"), WRONG_HEADERS)
def test_a_wrong_header_is_refused(
    tmp_path: Path, write: Callable[..., Path], old: bytes, new: bytes, problem: str
) -> None:
    path = write(tmp_path / f"a.{write.__name__[-3:]}", POINTS)
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    with refusal(DatasetError, str(path), problem):
        read_cloud(path)


@pytest.mark.parametrize(
    ("write", "encoding"), [*((write_pcd, e) for e in ENCODINGS), *((write_ply, e) for e in PLY_ENCODINGS)]
)
def test_a_cloud_that_is_cut_short_is_refused(
    tmp_path: Path, write: Callable[..., Path], encoding: str
) -> None:
    path = write(tmp_path / f"a.{write.__name__[-3:]}", POINTS, encoding)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DatasetError, match=r"cut short|values, expected") as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)


def test_a_packed_pcd_that_claims_too_much_is_not_unpacked(tmp_path: Path) -> None:
    path = write_pcd(tmp_path / "a.pcd", POINTS, "binary_compressed")
    path.write_bytes(re.sub(rb"(WIDTH|POINTS) 42", rb"\1 99999999", path.read_bytes()))
    with refusal(DatasetError, "claims to unpack"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"depth_m": np.zeros((2, 2))}, "contains no points"),
        ({"xyz": np.zeros((5, 2))}, r"xyz is float64 \(5, 2\)"),
        ({"xyz": np.array([["a", "b", "c"]])}, "expected numbers"),
    ],
)
def test_an_npz_without_points_is_refused(
    tmp_path: Path, arrays: dict[str, np.ndarray], problem: str
) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(DatasetError, match=problem):
        read_cloud(tmp_path / "a.npz")


@pytest.fixture
def laspy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "laspy", SimpleNamespace(open=lambda stream, closefd: LasFile(POINTS)))


@pytest.mark.usefixtures("laspy")
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(las_head(42, suffix == ".laz"))
    np.testing.assert_array_equal(read_cloud(path), POINTS)


@pytest.mark.usefixtures("laspy")
@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "not a LAS file, or its header is cut short"),
        (bytes(500), "not a LAS file"),
        (las_head(42)[:100], "its header is cut short"),
        (las_head(42)[:-1], "it claims 42 points of 28 bytes, more than it can hold"),
        (las_head(42, count=2**32 - 1), "it claims 4,294,967,295 points"),
        (las_head(42, records=2**31), "it claims 2,147,483,648 records before its points"),
        (las_head(42, begin=2**31), "before its points, more than there is room for"),
        (las_head(42, True, table=2**40), "the table of its chunks is not in the file"),
        (las_head(42, True, chunks=2**31), "it claims 2,147,483,648 chunks of points"),
        (las_head(42, True, chunk_points=2**31), "it claims chunks of 2,147,483,648 points"),
        (las_head(42, True, count=2**30), "it claims 1,073,741,824 points of 28 bytes"),
    ],
)
def test_a_las_that_claims_what_it_cannot_hold_is_refused(tmp_path: Path, data: bytes, problem: str) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=problem) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: cannot be read: ")


def test_a_panic_of_the_unpacker_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class PanicException(BaseException):
        """Error that extensions in Rust raise."""

    def panic(stream: object, closefd: bool) -> None:
        raise PanicException("capacity overflow")

    monkeypatch.setitem(sys.modules, "laspy", SimpleNamespace(open=panic))
    (tmp_path / "a.las").write_bytes(las_head(3))
    with pytest.raises(DatasetError, match=r"a\.las: cannot be read, it is damaged: capacity overflow"):
        read_cloud(tmp_path / "a.las")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_as_laspy_writes_it(tmp_path: Path, suffix: str) -> None:
    laspy = pytest.importorskip("laspy", reason="LAS files need laspy")
    file = laspy.create(point_format=3, file_version="1.2")
    file.header.scales = [0.001] * 3
    file.x, file.y, file.z = np.asarray(Walk(1).clouds[0], np.float64).T
    path = tmp_path / f"a{suffix}"
    file.write(path)
    np.testing.assert_allclose(read_cloud(path), Walk(1).clouds[0], atol=6e-4)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DatasetError, match="cannot be read"):
        read_cloud(path)


def test_meshes_and_images_are_no_clouds(tmp_path: Path) -> None:
    np.savez(tmp_path / "depth.npz", depth_m=np.zeros((2, 2)))
    assert not is_cloud(tmp_path / "depth.npz")
    assert not is_cloud(write_ply(tmp_path / "mesh.ply", POINTS, faces=3))
    assert is_cloud(write_ply(tmp_path / "cloud.ply", POINTS))
    (tmp_path / "damaged.ply").write_bytes(b"ply\n")
    assert is_cloud(tmp_path / "damaged.ply")


def test_names_are_ordered_by_their_numbers() -> None:
    names = ["scan-10", "scan-9", "scan-0100", "a2"]
    ordered = [path.stem for path in sorted(map(Path, names), key=natural)]
    assert ordered == ["a2", "scan-9", "scan-10", "scan-0100"]


@pytest.mark.shared_data
def test_the_structured_scene_has_its_viewpoints(shared_data: Path) -> None:
    points, T_world_sensor = read_pcd(shared_data / "la3dm_structured" / "sim_structured_1.pcd")
    assert points.shape == (3500, 3)
    np.testing.assert_allclose(T_world_sensor[:3, 3], [0.999982, 1.00002, 0.0997627])
    assert np.linalg.norm(points - T_world_sensor[:3, 3], axis=1).max() < 11.0


ROOM = RoomWalk(6)


T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def as_of_camera(poses: list[Pose]) -> list[Pose]:
    """The poses in a camera's convention of axes."""
    return [T_CAMERA_LIDAR @ T @ T_CAMERA_LIDAR.T for T in poses]


def write_npz(path: Path, points: Points) -> None:
    np.savez(path, xyz=points)


def write_bin(path: Path, points: Points) -> None:
    np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4").tofile(path)


def write_las(path: Path, points: Points) -> None:
    laspy = pytest.importorskip("laspy")
    file = laspy.create(point_format=3, file_version="1.2")
    file.header.scales = [1e-4] * 3
    file.x, file.y, file.z = np.asarray(points, np.float64).T
    file.write(path)


WRITERS: dict[str, Callable[[Path, Points], object]] = {
    "ply": write_ply, "pcd": write_pcd, "npz": write_npz, "bin": write_bin, "las": write_las,
}  # fmt: skip


def write(folder: Path, suffix: str, clouds: list[Points], poses: list[Pose] | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    for i, cloud in enumerate(clouds):
        WRITERS[suffix](folder / f"scan{i}.{suffix}", cloud)
    if poses is not None:
        write_rows(folder / "poses.txt", poses)
    return folder


def check_rays(dataset: Dataset, moved: float = 0.0, world: Pose | None = None) -> None:
    """The scans are those of the sensor, at its poses."""
    for i, frame in enumerate(dataset):
        points = (frame.camera.rays() * frame.depth_m[..., None]).reshape(-1, 3)
        off = np.sort(points, axis=0) - np.sort(ROOM.clouds[i], axis=0)  # rays have an order of their own
        np.testing.assert_allclose(off, 0.0, atol=2e-3)
        T = ROOM.poses[i].copy() if world is None else world @ ROOM.poses[i]
        T[:2, 3] += moved
        np.testing.assert_allclose(frame.T_world_camera, T, atol=1e-6)


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("frame", ["sensor", "world"])
def test_the_frame_of_points_is_found(tmp_path: Path, suffix: str, frame: str) -> None:
    clouds = ROOM.clouds if frame == "sensor" else ROOM.in_world()
    dataset = open_dataset(write(tmp_path / "walk", suffix, clouds, ROOM.poses))
    check_rays(dataset)
    told = [note for note in dataset.notes if "?points=sensor" in note]
    assert len(told) == (frame == "world")


def test_poses_of_another_convention_are_refused(tmp_path: Path) -> None:
    inverses = [np.linalg.inv(T) for T in ROOM.poses]
    folder = write(tmp_path / "inverse", "ply", ROOM.clouds, inverses)
    refused(folder, "clouds fit together best if", "--poses-are inverse")
    check_rays(open_dataset(folder, poses_are="inverse"))
    registered = write(tmp_path / "registered", "ply", ROOM.in_world(), inverses)
    check_rays(open_dataset(registered, poses_are="inverse"))
    camera = write(tmp_path / "camera", "ply", ROOM.clouds, as_of_camera(ROOM.poses))
    refused(camera, "clouds fit together best if", "--mounting 0,0,0,0.5,-0.5,0.5,0.5")
    mounted = open_dataset(camera, mounting=(0, 0, 0, 0.5, -0.5, 0.5, 0.5))
    check_rays(mounted, world=T_CAMERA_LIDAR)
    assert carry_out("doctor", folder, "--poses-are", "inverse") == 0


@pytest.mark.parametrize("frame", ["sensor", "world"])
def test_the_frame_of_points_of_kitti_is_found(tmp_path: Path, frame: str) -> None:
    write(tmp_path, "bin", [], as_of_camera(ROOM.poses))
    (tmp_path / "velodyne").mkdir()
    for i, cloud in enumerate(ROOM.clouds if frame == "sensor" else ROOM.in_world()):
        write_bin(tmp_path / "velodyne" / f"{i:06d}.bin", cloud)
    (tmp_path / "calib.txt").write_text(f"Tr: {row_of(T_CAMERA_LIDAR[:3])}")
    dataset = open_dataset(tmp_path)
    check_rays(dataset)
    assert any("points are in the world's frame" in note for note in dataset.notes) == (frame == "world")


@pytest.mark.parametrize("frame", ["sensor", "world"])
def test_the_frame_of_points_with_viewpoints_is_found(tmp_path: Path, frame: str) -> None:
    clouds = ROOM.clouds if frame == "sensor" else ROOM.in_world()
    for i, (cloud, T) in enumerate(zip(clouds, ROOM.poses, strict=True)):
        write_pcd(tmp_path / f"{i}.pcd", cloud, "binary", T)
    dataset = open_dataset(tmp_path)
    check_rays(dataset)
    assert any("?points=world" in note for note in dataset.notes) == (frame == "sensor")


def test_the_caller_says_in_which_frame_points_are(tmp_path: Path) -> None:
    folder = write(tmp_path / "walk", "ply", ROOM.clouds, ROOM.poses)
    check_rays(open_dataset(f"{folder}?points=sensor"))
    with pytest.raises(AssertionError):
        check_rays(open_dataset(f"{folder}?points=world"))
    refused(f"{folder}?points=map", "points must be sensor or world, not 'map'")


@pytest.mark.parametrize("frame", ["sensor", "world"])
def test_a_sensor_far_from_the_origin(tmp_path: Path, frame: str) -> None:
    """Few points, of one scan, are told by where they lie."""
    far = 60.0
    poses = [T.copy() for T in ROOM.poses]
    for T in poses:
        T[:2, 3] += far
    clouds = (
        ROOM.clouds if frame == "sensor" else [cloud + np.array([far, far, 0]) for cloud in ROOM.in_world()]
    )
    check_rays(open_dataset(write(tmp_path / "walk", "ply", clouds[:1], poses[:1])), far)


def two_rooms() -> Points:
    """A map of two rooms behind each other, whose origin is in the first."""
    cloud = np.vstack(ROOM.in_world())
    return np.vstack([cloud, 1.5 * cloud + [12.0, 0.0, 0.0], 3 * cloud])


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_cloud_that_is_a_map_is_refused(tmp_path: Path, suffix: str) -> None:
    folder = write(tmp_path / "walk", suffix, [two_rooms()])
    refused(folder / f"scan0.{suffix}", "poses")
    write_rows(folder / "poses.txt", ROOM.poses)
    refused(folder, "poses.txt: contains 6 poses for one cloud, scan0")


def test_one_scan_from_the_origin_is_no_map(tmp_path: Path) -> None:
    path = write_pcd(tmp_path / "a.pcd", ROOM.clouds[0])
    assert len(open_dataset(path)) == 1
    refused(write_pcd(tmp_path / "b.pcd", two_rooms()), "its VIEWPOINT is the origin,", "?points=sensor")
    assert len(open_dataset(f"{tmp_path / 'b.pcd'}?points=sensor")) == 1


@pytest.mark.parametrize("suffix", WRITERS)
def test_clouds_in_one_frame_without_poses_are_refused(tmp_path: Path, suffix: str) -> None:
    refused(write(tmp_path / "walk", suffix, ROOM.in_world()), "poses")
