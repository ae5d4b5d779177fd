"""Point clouds in files: PCD of three encodings, PLY, npz and KITTI's, whole and damaged."""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from point_clouds import LasFile, Walk, las_head, lzf, write_pcd, write_ply

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.lidar.clouds import (
    is_cloud,
    natural,
    read_cloud,
    read_pcd,
    read_ply_points,
    unpack_lzf,
)
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import look_at

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
    with pytest.raises(DatasetError, match=r"1\.bin: has 17 bytes, which is no whole number of points"):
        read_cloud(tmp_path / "1.bin")


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
def test_numbers_of_a_point_are_found_by_what_fits(tmp_path: Path, columns: int) -> None:
    """In a room, with reflectance, ring and time. The size of 960 points fits all numbers of columns."""
    random = np.random.default_rng(columns)
    points = random.uniform([-3, -2, -1], [3, 2, 1.5], (960, 3))
    more = [random.uniform(0, 1, 960), np.arange(960) % 24, np.linspace(0, 0.1, 960)]
    table = np.column_stack([points, *more])[:, :columns].astype("<f4")
    table.tofile(tmp_path / "0.bin")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        np.testing.assert_array_equal(read_cloud(tmp_path / "0.bin"), table[:, :3])
    said = (
        [f".bin files with {columns} numbers a point, of which the first are x y z"] if columns != 4 else []
    )
    assert [str(each.message) for each in caught] == said


def test_what_is_odd_of_a_recording_is_a_note_and_no_warning(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    random = np.random.default_rng(0)
    for scan in range(2):
        table = [random.uniform([-3, -2, -1], [3, 2, 1.5], (960, 3)), np.full(960, 12.0), np.arange(960) % 24]
        np.column_stack(table).astype("<f4").tofile(tmp_path / f"{scan}.bin")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    notes = open_dataset(tmp_path).notes
    assert notes.count(".bin files with 5 numbers a point, of which the first are x y z") == 1
    assert len(recwarn) == 0


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


Change = tuple[bytes, bytes, str]
PCD_DAMAGE: list[Change] = [
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
]


@pytest.mark.parametrize(("old", "new", "problem"), PCD_DAMAGE)
def test_a_pcd_with_a_wrong_header_is_refused(tmp_path: Path, old: bytes, new: bytes, problem: str) -> None:
    path = write_pcd(tmp_path / "a.pcd", POINTS)
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    with pytest.raises(DatasetError, match=problem) as caught:
        read_pcd(path)
    assert str(path) in str(caught.value)


PLY_DAMAGE: list[Change] = [
    (b"ply\n", b"plywood\n", "not a PLY file"),
    (b"end_header", b"the end", "not a PLY file, or its header has no end"),
    (b"format binary_little_endian", b"format morse", "format 'morse' is not one of"),
    (b"property double y", b"property double w", "no property y"),
    (b"property float z", b"property list uchar float z", "is not one number"),
    (b"property float z", b"property double x", "is not one number"),
    (b"element vertex 42", b"element vertex many", "'many' is no number of elements"),
    (b"element vertex 42", b"element vertex", "is cut short"),
    (b"element vertex", b"element camera", "first element is not the vertex"),
]


@pytest.mark.parametrize(("old", "new", "problem"), PLY_DAMAGE)
def test_a_ply_with_a_wrong_header_is_refused(tmp_path: Path, old: bytes, new: bytes, problem: str) -> None:
    path = write_ply(tmp_path / "a.ply", POINTS)
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(DatasetError, match=problem) as caught:
        read_ply_points(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("write", [write_pcd, write_ply])
@pytest.mark.parametrize("place", range(3))
def test_a_cloud_that_is_cut_short_is_refused(
    tmp_path: Path, write: Callable[[Path, np.ndarray, str], Path], place: int
) -> None:
    encoding = (ENCODINGS if write is write_pcd else PLY_ENCODINGS)[place]
    path = write(tmp_path / f"a.{'pcd' if write is write_pcd else 'ply'}", POINTS, encoding)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DatasetError, match=r"cut short|values, expected") as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)


def test_a_packed_pcd_that_claims_too_much_is_not_unpacked(tmp_path: Path) -> None:
    path = write_pcd(tmp_path / "a.pcd", POINTS, "binary_compressed")
    path.write_bytes(
        path.read_bytes().replace(b"WIDTH 42", b"WIDTH 99999999").replace(b"POINTS 42", b"POINTS 99999999")
    )
    with pytest.raises(DatasetError, match="claims to unpack"):
        read_pcd(path)


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
        (b"", "it is no LAS file, or its header is cut short"),
        (bytes(500), "it is no LAS file"),
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
        """What extensions in Rust raise."""

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
