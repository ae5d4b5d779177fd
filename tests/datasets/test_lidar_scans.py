"""Recordings of lidar scans: every layout gives the same rays at the same poses; damage is named."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import row_of, stamped_line
from point_clouds import Walk, write_pcd, write_ply, write_scans, write_velodyne
from refusals import refused

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH, LIDAR_SIGMA_M, LidarScans, reach_of
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.errors import FrameError
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

WALK = Walk()
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0.02], [0, 0, -1, -0.06], [1, 0, 0, -0.3], [0, 0, 0, 1]])


def rows_of_poses(path: Path) -> None:
    path.write_text("\n".join(row_of(pose[:3]) for pose in WALK.poses))


def npz_scans(folder: Path) -> Path:
    return write_scans(folder, WALK)


def plies_with_rows(folder: Path) -> Path:
    folder.mkdir()
    for i, cloud in enumerate(WALK.clouds):
        write_ply(folder / f"cloud_{i + 8}.ply", cloud)
    rows_of_poses(folder / "poses.txt")
    return folder


def plies_named_by_time(folder: Path) -> Path:
    """Names in nanoseconds, and poses a little before and after each."""
    (folder / "clouds").mkdir(parents=True)
    lines = []
    for i, cloud in enumerate(WALK.clouds):
        stamp = 1_600_000_000 + i
        write_ply(folder / "clouds" / f"{stamp}500000000.ply", cloud, "ascii")
        lines += [stamped_line(stamp + 0.5 + shift, WALK.poses[i]) for shift in (-0.05, 0.05)]
    (folder / "trajectory.txt").write_text("\n".join(lines))
    return folder


def pcds_with_poses(folder: Path) -> Path:
    folder.mkdir()
    for i, cloud in enumerate(WALK.clouds):
        write_pcd(folder / f"{i}.pcd", cloud, "binary_compressed")
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


LAYOUTS: list[Callable[[Path], Path]] = [
    npz_scans, plies_with_rows, plies_named_by_time, pcds_with_poses, pcds_with_viewpoints, velodyne,
]  # fmt: skip


def points_of(frame: Frame) -> np.ndarray:
    """The points of a scan in the sensor's frame, sorted."""
    points = (frame.camera.rays() * frame.depth_m[..., None]).reshape(-1, 3)
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read_rightly(tmp_path: Path, layout: Callable[[Path], Path]) -> None:
    dataset = open_dataset(layout(tmp_path / "walk"))
    assert isinstance(dataset, LidarScans)
    assert dataset.name == "walk"
    assert len(dataset) == WALK.count
    T_world_first = WALK.poses[0] if layout is velodyne else np.eye(4)
    for i, frame in enumerate(dataset):
        assert isinstance(frame.camera, RayTable)
        assert frame.depth_m.shape == frame.camera.shape
        expected = WALK.clouds[i].astype(np.float64)
        np.testing.assert_allclose(points_of(frame), expected[np.lexsort(expected.T)], atol=2e-3)
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
def test_stamps(tmp_path: Path, layout: Callable[[Path], Path], stamps: list[float]) -> None:
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
    moved = [stamped_line(float(i), pose) for i, pose in enumerate(WALK.poses[::-1])]
    (tmp_path / "other.txt").write_text("\n".join(moved))
    dataset = open_dataset(f"{folder}?poses={tmp_path / 'other.txt'}")
    np.testing.assert_allclose(dataset.read(0).T_world_camera, WALK.poses[2], atol=1e-6)
    refused(f"{folder}?pose=x", "unknown parameter 'pose'")


@pytest.mark.parametrize("write", [write_pcd, write_ply])
def test_clouds_whose_poses_are_elsewhere(tmp_path: Path, write: Callable[[Path, np.ndarray], Path]) -> None:
    folder = tmp_path / "walk"
    folder.mkdir()
    for i, cloud in enumerate(WALK.clouds):
        write(folder / f"{i}.{'pcd' if write is write_pcd else 'ply'}", cloud)
    rows_of_poses(tmp_path / "elsewhere.txt")
    dataset = open_dataset(f"{folder}?poses={tmp_path / 'elsewhere.txt'}")
    np.testing.assert_allclose(dataset.read(1).T_world_camera, WALK.poses[1], atol=1e-6)
    said = refused(folder)
    assert "poses are not known" in said if write is write_pcd else "no poses for its 3 scans" in said


def test_rows_of_poses_go_by_the_order_of_names_or_by_their_numbers(tmp_path: Path) -> None:
    """Of three scans with one number twice the poses are clear if there are three."""
    for name, cloud in zip(("a1", "b1", "c2"), WALK.clouds, strict=True):
        write_ply(tmp_path / f"{name}.ply", cloud)
    rows_of_poses(tmp_path / "poses.txt")
    for frame, pose in zip(open_dataset(tmp_path), WALK.poses, strict=True):
        np.testing.assert_allclose(frame.T_world_camera, pose, atol=1e-6)
    (tmp_path / "poses.txt").write_text("\n".join([row_of(WALK.poses[0][:3])] * 5))
    refused(tmp_path, "go by the numbers of scans, but names such as a1.ply")
    (tmp_path / "b1.ply").rename(tmp_path / "b4.ply")
    assert open_dataset(tmp_path).frame_names == ["a1", "c2", "b4"]


def test_scans_come_in_the_order_of_their_times(tmp_path: Path) -> None:
    lines = []
    for name, pose, cloud in zip(("1.5", "1.25", "1.125"), WALK.poses, WALK.clouds, strict=True):
        write_ply(tmp_path / f"{name}.ply", cloud)
        lines.append(stamped_line(float(name), pose))
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    dataset = open_dataset(tmp_path)
    assert dataset.frame_names == ["1.125", "1.25", "1.5"]
    np.testing.assert_allclose(dataset.read(0).T_world_camera, WALK.poses[2], atol=1e-6)


def without_pose(folder: Path, kind: str) -> Path:
    """A recording in which the last scan has no pose."""
    if kind == "npz":
        write_scans(folder, WALK)
        np.savez(
            folder / "poses.npz", scan=[0, 3], T_world_lidar=np.array(WALK.poses[:2]), stamp_s=[0.0, 1.0]
        )
    elif kind == "stamped":
        plies_named_by_time(folder)
        lines = (folder / "trajectory.txt").read_text().splitlines()
        (folder / "trajectory.txt").write_text("\n".join(lines[:4]))
    else:
        write_velodyne(folder, WALK, T_CAMERA_LIDAR)
        lines = (folder / "poses.txt").read_text().splitlines()
        (folder / "poses.txt").write_text("\n".join(lines[:2]))
    return folder


@pytest.mark.parametrize("kind", ["npz", "stamped", "velodyne"])
def test_scans_without_a_pose_are_dropped_and_counted(tmp_path: Path, kind: str) -> None:
    dataset = open_dataset(without_pose(tmp_path / "walk", kind))
    assert (len(dataset), dataset.dropped) == (2, 1)
    assert any("1 of 3 scans dropped" in note for note in dataset.notes)


def test_viewpoints_that_pcl_writes_by_default_are_no_poses(tmp_path: Path) -> None:
    for i, cloud in enumerate(WALK.clouds):
        write_pcd(tmp_path / f"{i}.pcd", cloud)
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
    lines = [stamped_line(float(i), pose) for i, pose in enumerate([*WALK.poses, WALK.poses[0]])]
    (folder / "poses.txt").write_text("\n".join(lines))
    refused(folder, "contains 4 poses with stamps for 3 scans, whose names are no stamps")
    (folder / "poses2.txt").write_text("\n".join(lines))
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
    with pytest.raises(FrameError, match=r"^frame scan-000: ") as caught:
        dataset.read(0)
    assert (
        "poses.npz: T_world_lidar 0" in str(caught.value)
        if how == "pose"
        else "scan-000" in str(caught.value)
    )
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
    refused(
        folder, "no scan can be read: frame scan-000: ", "scan-000.npz: none of 4 points is a measurement"
    )


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
        folder.mkdir()
        for i, cloud in enumerate(WALK.clouds):
            write_ply(folder / f"{i}.ply", unit * cloud)
        rows_of_poses(folder / "poses.txt")
    refused(millimetres, r"which are hardly metres: --depth-scale 1000 takes them for millimetres")
    expected, found = open_dataset(metres), open_dataset(millimetres, depth_scale=1000.0)
    for i in range(len(expected)):
        np.testing.assert_allclose(found.read(i).depth_m, expected.read(i).depth_m, rtol=1e-6)
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
