"""Recordings of lidar scans: every layout gives the same rays at the same poses; damage is named."""

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets_recordings import write_rows, write_stamped
from point_clouds import Walk, in_order, write_pcd, write_ply, write_scans, write_velodyne
from refusals import bad_frame, refused

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH, LIDAR_SIGMA_M, LidarScans, reach_of
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

WALK = Walk()
Writer = Callable[[Path, np.ndarray], Any]
Layout = Callable[[Path], Path]
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0.02], [0, 0, -1, -0.06], [1, 0, 0, -0.3], [0, 0, 0, 1]])


def npz_scans(folder: Path) -> Path:
    return write_scans(folder, WALK)


def write_clouds(folder: Path, names: Sequence[str], write: Writer = write_ply, unit: float = 1.0) -> Path:
    """Clouds of the walk under these names."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, cloud in zip(names, WALK.clouds, strict=True):
        write(folder / name, unit * cloud)
    return folder


def plies_with_rows(folder: Path) -> Path:
    write_clouds(folder, ["cloud_8.ply", "cloud_9.ply", "cloud_10.ply"])
    write_rows(folder / "poses.txt", WALK.poses)
    return folder


def plies_named_by_time(folder: Path) -> Path:
    """Names in nanoseconds, and poses a little before and after each."""
    seconds = [1_600_000_000 + i for i in range(WALK.count)]
    ascii = partial(write_ply, encoding="ascii")
    write_clouds(folder / "clouds", [f"{second}500000000.ply" for second in seconds], ascii)
    stamps = [second + 0.5 + shift for second in seconds for shift in (-0.05, 0.05)]
    write_stamped(folder / "trajectory.txt", stamps, [T for T in WALK.poses for _ in range(2)])
    return folder


def pcds_with_poses(folder: Path) -> Path:
    write_clouds(folder, ["0.pcd", "1.pcd", "2.pcd"], partial(write_pcd, encoding="binary_compressed"))
    np.savez(folder / "poses.npz", T_world_sensor=np.array(WALK.poses))
    return folder


def pcds_with_viewpoints(folder: Path) -> Path:
    folder.mkdir()
    for i, (cloud, T) in enumerate(zip(WALK.clouds, WALK.poses, strict=True)):
        write_pcd(folder / f"scan{i}.pcd", cloud @ T[:3, :3].T + T[:3, 3], "binary", T)
    return folder


def plies_with_times(folder: Path) -> Path:
    plies_with_rows(folder)
    (folder / "times.txt").write_text("3.5\n4.0\n4.5\n")
    return folder


def velodyne(folder: Path) -> Path:
    return write_velodyne(folder, WALK, T_CAMERA_LIDAR)


LAYOUTS: list[Layout] = [
    npz_scans, plies_with_rows, plies_named_by_time, pcds_with_poses, pcds_with_viewpoints, velodyne,
]  # fmt: skip


def points_of(frame: Frame) -> np.ndarray:
    """The points of a scan in the sensor's frame, sorted."""
    return in_order(frame.camera.rays() * frame.depth_m[..., None])


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read_rightly(tmp_path: Path, layout: Layout) -> None:
    dataset = open_dataset(layout(tmp_path / "walk"))
    assert isinstance(dataset, LidarScans)
    assert dataset.name == "walk"
    assert len(dataset) == WALK.count
    T_world_first = WALK.poses[0] if layout is velodyne else np.eye(4)
    for i, frame in enumerate(dataset):
        assert isinstance(frame.camera, RayTable)
        assert frame.depth_m.shape == frame.camera.shape
        np.testing.assert_allclose(points_of(frame), in_order(WALK.clouds[i]), atol=2e-3)
        # KITTI's world is the lidar at the first pose.
        np.testing.assert_allclose(T_world_first @ frame.T_world_camera, WALK.poses[i], atol=1e-6)
    assert dataset.camera == dataset.read(0).camera


@pytest.mark.parametrize(
    ("layout", "stamps"),
    [
        (npz_scans, [5.0, 6.0, 7.0]),
        (plies_with_rows, [0.0, 0.1, 0.2]),
        (plies_with_times, [3.5, 4.0, 4.5]),
        (plies_named_by_time, [1_600_000_000.5, 1_600_000_001.5, 1_600_000_002.5]),
        (pcds_with_viewpoints, [0.0, 0.1, 0.2]),
        (velodyne, [0.0, 0.25, 0.5]),
    ],
)
def test_stamps(tmp_path: Path, layout: Layout, stamps: list[float]) -> None:
    assert [frame.stamp for frame in open_dataset(layout(tmp_path / "walk"))] == pytest.approx(stamps)


def test_velodyne_may_be_named_itself_and_its_poses_elsewhere(tmp_path: Path) -> None:
    folder = write_velodyne(tmp_path / "sequences" / "07", WALK, T_CAMERA_LIDAR, times=False)
    (tmp_path / "poses").mkdir()
    shutil.move(folder / "poses.txt", tmp_path / "poses" / "07.txt")
    dataset = open_dataset(folder / "velodyne")
    assert [frame.stamp for frame in dataset] == pytest.approx([0.0, 0.1, 0.2])
    assert any("no times.txt" in note for note in dataset.notes)


def test_one_pcd_is_a_recording(tmp_path: Path) -> None:
    path = write_pcd(tmp_path / "a.pcd", WALK.clouds[0], "ascii", WALK.poses[0])
    assert open_dataset(path).frame_names == ["a"]


def test_poses_of_another_file(tmp_path: Path) -> None:
    folder = plies_with_rows(tmp_path / "walk")
    other = write_stamped(tmp_path / "other.txt", range(WALK.count), WALK.poses[::-1])
    dataset = open_dataset(f"{folder}?poses={other}")
    np.testing.assert_allclose(dataset.read(0).T_world_camera, WALK.poses[2], atol=1e-6)
    refused(f"{folder}?pose=x", "unknown parameter 'pose'")


@pytest.mark.parametrize(
    ("write", "suffix", "said"),
    [(write_pcd, "pcd", "poses are not known"), (write_ply, "ply", "no poses for its 3 scans")],
)
def test_clouds_whose_poses_are_elsewhere(tmp_path: Path, write: Writer, suffix: str, said: str) -> None:
    folder = write_clouds(tmp_path / "walk", [f"{i}.{suffix}" for i in range(WALK.count)], write)
    poses = write_rows(tmp_path / "elsewhere.txt", WALK.poses)
    dataset = open_dataset(f"{folder}?poses={poses}")
    np.testing.assert_allclose(dataset.read(1).T_world_camera, WALK.poses[1], atol=1e-6)
    refused(folder, said)


def test_rows_of_poses_go_by_the_order_of_names_or_by_their_numbers(tmp_path: Path) -> None:
    """Of three scans with one number twice the poses are clear if there are three."""
    write_clouds(tmp_path, ["a1.ply", "b1.ply", "c2.ply"])
    write_rows(tmp_path / "poses.txt", WALK.poses)
    for frame, pose in zip(open_dataset(tmp_path), WALK.poses, strict=True):
        np.testing.assert_allclose(frame.T_world_camera, pose, atol=1e-6)
    write_rows(tmp_path / "poses.txt", WALK.poses[:1] * 5)
    refused(tmp_path, "go by the numbers of scans, but names such as a1.ply")
    (tmp_path / "b1.ply").rename(tmp_path / "b4.ply")
    assert open_dataset(tmp_path).frame_names == ["a1", "c2", "b4"]


def test_scans_come_in_the_order_of_their_times(tmp_path: Path) -> None:
    write_clouds(tmp_path, ["1.5.ply", "1.25.ply", "1.125.ply"])
    write_stamped(tmp_path / "poses.txt", [1.5, 1.25, 1.125], WALK.poses)
    dataset = open_dataset(tmp_path)
    assert dataset.frame_names == ["1.125", "1.25", "1.5"]
    np.testing.assert_allclose(dataset.read(0).T_world_camera, WALK.poses[2], atol=1e-6)


def without_npz_pose(folder: Path) -> Path:
    write_scans(folder, WALK)
    poses = np.array(WALK.poses[:2])
    np.savez(folder / "poses.npz", scan=[0, 3], T_world_lidar=poses, stamp_s=[0.0, 1.0])
    return folder


def without_lines(layout: Layout, name: str, kept: int) -> Layout:
    """A recording of whose file of poses only the first lines are there."""

    def write(folder: Path) -> Path:
        path = layout(folder) / name
        path.write_text("\n".join(path.read_text().splitlines()[:kept]))
        return folder

    return write


@pytest.mark.parametrize(
    "layout",
    [
        without_npz_pose,
        without_lines(plies_named_by_time, "trajectory.txt", 4),
        without_lines(velodyne, "poses.txt", 2),
    ],
    ids=["npz", "stamped", "velodyne"],
)
def test_scans_without_a_pose_are_dropped_and_counted(tmp_path: Path, layout: Layout) -> None:
    dataset = open_dataset(layout(tmp_path / "walk"))
    assert (len(dataset), dataset.dropped) == (2, 1)
    assert any("1 of 3 scans dropped" in note for note in dataset.notes)


def test_viewpoints_that_pcl_writes_by_default_are_no_poses(tmp_path: Path) -> None:
    write_clouds(tmp_path, ["0.pcd", "1.pcd", "2.pcd"], write_pcd)
    refused(tmp_path, "the VIEWPOINT of all 3 clouds is the origin, so their poses are not known")


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("poses.txt", "", "no poses of its scans"),
        ("poses.txt", "1 0 0 0", "poses.txt line 1: 4 numbers"),
        ("poses.txt", "0 0 0 0 0 0 0 1", "expected a 3 x 4 matrix"),
        ("calib.txt", "P0: 1 2 3", "calib.txt: has no line Tr:"),
        ("calib.txt", "Tr: 1 2 3", "calib.txt: Tr must be 12 numbers"),
        ("calib.txt", "Tr: 1 2 3 4 5 6 7 8 9 10 11 twelve", "calib.txt: Tr must be 12 numbers"),
        ("calib.txt", "Tr: 2 0 0 0 0 2 0 0 0 0 2 0", "calib.txt: Tr: the rotation of a pose is not one"),
        ("times.txt", "0.1\nlater\n", "times.txt line 2"),
    ],
)
def test_damaged_files_of_kitti_are_named(tmp_path: Path, name: str, text: str, problem: str) -> None:
    folder = velodyne(tmp_path / "walk")
    (folder / name).write_text(text) if text else (folder / name).unlink()
    refused(folder, problem)


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"stamp_s": np.zeros(3)}, "poses.npz: contains no T_world_lidar, T_world_sensor"),
        ({"T_world_lidar": np.zeros((3, 5))}, r"poses.npz: T_world_lidar is float64 (3, 5)"),
        ({"T_world_lidar": np.zeros((2, 4, 4))}, "contains 2 poses and no array scan, for 3 scans"),
        ({"T_world_lidar": np.zeros((3, 4, 4)), "scan": np.array([0, 1])}, "poses.npz: scan"),
        ({"T_world_lidar": np.zeros((3, 4, 4)), "stamp_s": np.array([0, 1, np.nan])}, "not finite"),
        ({"T_world_lidar": np.zeros((3, 4, 4)), "scan": np.array([50, 51, 52])}, "has a pose for none"),
    ],
)
def test_damaged_poses_are_named(tmp_path: Path, arrays: dict[str, np.ndarray], problem: str) -> None:
    folder = npz_scans(tmp_path / "walk")
    np.savez(folder / "poses.npz", **arrays)
    refused(folder, problem)


def test_as_many_stamped_poses_as_scans_or_names_that_are_times(tmp_path: Path) -> None:
    folder = plies_with_rows(tmp_path / "walk")
    write_stamped(folder / "poses.txt", range(4), [*WALK.poses, WALK.poses[0]])
    refused(folder, "contains 4 poses with stamps for 3 scans, whose names are not stamps")
    shutil.copy(folder / "poses.txt", folder / "poses2.txt")
    refused(folder, "contains several files of poses, poses.txt, poses2.txt")


@pytest.mark.parametrize("option", [{"intrinsics": (9.0, 9.0, 4.0, 4.0)}, {"image_scale": 0.5}])
def test_options_of_images_are_refused(tmp_path: Path, option: dict[str, object]) -> None:
    refused(npz_scans(tmp_path / "walk"), "contains lidar scans", **option)


def spoil(folder: Path, how: str) -> None:
    """Damage the first of three scans."""
    path = folder / "scan-000.npz"
    if how == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    elif how == "empty":
        np.savez(path, xyz=np.zeros((0, 3)))
    elif how == "no returns":
        np.savez(path, xyz=np.array([[0, 0, 0], [np.nan, 1, 1], [np.inf, 0, 0], [1e300, 0, 0]]))
    else:
        poses = np.array(WALK.poses)
        poses[0, 0, 0] = np.nan
        np.savez(folder / "poses.npz", scan=[0, 3, 12], T_world_lidar=poses)


@pytest.mark.parametrize("how", ["cut", "empty", "no returns", "pose"])
def test_a_broken_scan_is_named_and_the_others_are_read(tmp_path: Path, how: str) -> None:
    folder = npz_scans(tmp_path / "walk")
    spoil(folder, how)
    dataset = open_dataset(folder)
    bad_frame(dataset, 0, "poses.npz: T_world_lidar 0" if how == "pose" else "scan-000.npz")
    assert dataset.camera == dataset.read(1).camera


def test_points_that_are_no_measurements_are_left_out(tmp_path: Path) -> None:
    folder = npz_scans(tmp_path / "walk")
    np.savez(folder / "scan-000.npz", xyz=np.array([[0, 0, 0], [np.nan, 1, 1], [2.0, 0, 0], [np.inf, 0, 0]]))
    frame = open_dataset(folder).read(0)
    np.testing.assert_array_equal(points_of(frame), [[2.0, 0.0, 0.0]])


def test_no_scan_that_can_be_read(tmp_path: Path) -> None:
    folder = npz_scans(tmp_path / "walk")
    for path in folder.glob("scan-*.npz"):
        np.savez(path, xyz=np.zeros((4, 3)))
    said = "scan-000.npz: none of 4 points is a measurement"
    refused(folder, "no scan can be read: frame scan-000: ", said)


def test_what_is_known_of_a_lidar_takes_the_place_of_the_defaults(tmp_path: Path) -> None:
    dataset = open_dataset(npz_scans(tmp_path / "walk"))
    filled = with_recorded_noise(Config(), dataset)
    assert filled.sensor == SensorConfig(sigma=(LIDAR_SIGMA_M,))
    assert filled.inference == InferenceConfig(pass_through=LIDAR_PASS_THROUGH)
    assert dataset.notes[-1] == (
        "inference.pass_through is 0.1, assumed for a lidar; setting inference.pass_through overrides it"
    )
    assert isinstance(dataset, LidarScans)
    dataset.reach_m = 40.0
    assert with_recorded_noise(Config(), dataset).sensor.max_depth == 40.0
    chosen = Config(
        sensor=SensorConfig(sigma=(0.01,), max_depth=25.0), inference=InferenceConfig(pass_through=0.0)
    )
    assert with_recorded_noise(chosen, dataset) == chosen
    assert [reach_of(np.array([0.0, x])) for x in (3.0, 10.0, 44.2, 1e30)] == [10.0, 10.0, 50.0, 500.0]
    assert reach_of(np.append(np.full(5000, 22.0), 1e9)) == 30.0, "a damaged point says nothing"


def test_points_in_millimetres_are_refused_with_the_flag_that_takes_them(tmp_path: Path) -> None:
    metres, millimetres = tmp_path / "m", tmp_path / "mm"
    for folder, unit in ((metres, 1.0), (millimetres, 1000.0)):
        write_clouds(folder, ["0.ply", "1.ply", "2.ply"], unit=unit)
        write_rows(folder / "poses.txt", WALK.poses)
    refused(millimetres, "pass --depth-scale 1000 if depth is in millimetres")
    expected, found = open_dataset(metres), open_dataset(millimetres, depth_scale=1000.0)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a.depth_m, b.depth_m, rtol=1e-6)
    far = open_dataset(millimetres, depth_scale=1.0)
    assert far.read(0).depth_m.max() > 1000
    assert far.notes[-1].endswith("set sensor.max_depth")


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "count", "points"), [("lidar_building", 59, 73452), ("la3dm_structured", 12, 3500)]
)
def test_real_scans(shared_data: Path, name: str, count: int, points: int) -> None:
    dataset = open_dataset(shared_data / name)
    first = dataset.read(0)
    assert (len(dataset), dataset.dropped, first.depth_m.size) == (count, 0, points)


@pytest.mark.shared_data
def test_scans_of_the_building_agree(shared_data: Path) -> None:
    """Points of one scan, seen from the next, lie where that measures in their directions."""
    dataset: Dataset = open_dataset(shared_data / "lidar_building")
    a, b = dataset.read(10), dataset.read(11)
    points = (a.camera.rays()[0] * a.depth_m[0, :, None])[::200]
    T = inverse(b.T_world_camera) @ a.T_world_camera
    seen = points @ T[:3, :3].T + T[:3, 3]
    range_m = np.linalg.norm(seen, axis=1)
    cosine = (seen / range_m[:, None]) @ b.camera.rays()[0].T
    nearest = cosine.argmax(axis=1)
    near = cosine.max(axis=1) > np.cos(0.005)
    assert near.mean() > 0.25
    assert np.median(np.abs(b.depth_m[0, nearest] - range_m)[near]) < 0.05
