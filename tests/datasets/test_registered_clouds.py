"""Points in the world's frame are cast from where the sensor was, in every format, or refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from console import carry_out
from datasets_recordings import row_of
from point_clouds import Points, RoomWalk, write_pcd, write_ply
from refusals import refused

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.geometry.poses import Pose

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
        (folder / "poses.txt").write_text("\n".join(row_of(T[:3]) for T in poses))
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
    (folder / "poses.txt").write_text("\n".join(row_of(T[:3]) for T in ROOM.poses))
    refused(folder, "poses.txt: contains 6 poses for one cloud, scan0")


def test_one_scan_from_the_origin_is_no_map(tmp_path: Path) -> None:
    path = write_pcd(tmp_path / "a.pcd", ROOM.clouds[0])
    assert len(open_dataset(path)) == 1
    refused(write_pcd(tmp_path / "b.pcd", two_rooms()), "its VIEWPOINT is the origin,", "?points=sensor")
    assert len(open_dataset(f"{tmp_path / 'b.pcd'}?points=sensor")) == 1


@pytest.mark.parametrize("suffix", WRITERS)
def test_clouds_in_one_frame_without_poses_are_refused(tmp_path: Path, suffix: str) -> None:
    refused(write(tmp_path / "walk", suffix, ROOM.in_world()), "poses")
