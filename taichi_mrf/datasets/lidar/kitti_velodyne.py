"""KITTI's velodyne scans (A. Geiger, P. Lenz and R. Urtasun, CVPR 2012).

A sequence's folder holds, and its ``velodyne`` may be named in its place:

- ``velodyne/NNNNNN.bin``: x y z and reflectance of each point, float32, in the lidar's frame (z up)
- ``calib.txt``: the 3 x 4 matrix ``Tr``, which takes the lidar's points to the left camera
- ``poses.txt``, or ``../../poses/NN.txt``: for each scan the 3 x 4 pose of the left camera
- ``times.txt``: for each scan its stamp in seconds; without it scans are 0.1 s apart

The world is the frame of the lidar at the first pose, as SemanticKITTI has it: T_world_lidar is Tr^-1 P Tr.
"""

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.entries import velodyne_sequence
from taichi_mrf.datasets.lidar.clouds import natural, number_of, read_cloud
from taichi_mrf.datasets.lidar.registered import in_world, of_sensor
from taichi_mrf.datasets.lidar.scans import SECONDS_PER_SCAN, RecordedScan, lidar_scans
from taichi_mrf.datasets.mended import pose_of
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.stereo.pairs import read_times
from taichi_mrf.datasets.trajectories import RecordedPose, Trajectory, read_trajectory
from taichi_mrf.errors import DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, as_pose, inverse
from taichi_mrf.system.files import is_file, is_folder, read_text

SCANS, CALIBRATION, POSES, TIMES = "velodyne", "calib.txt", "poses.txt", "times.txt"
_TO_CAMERA = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")


def open_folder(path: Path, options: ReadOptions) -> Dataset:
    """List the scans in the order of their numbers. Raises DatasetError, which names the file and line."""
    folder = velodyne_sequence(path)
    assert folder is not None
    files = _scans(folder)
    T_camera_lidar = read_calibration(folder / CALIBRATION)
    poses = _poses(folder)
    notes, stamps = [], None
    if is_file(folder / TIMES):
        stamps = read_times(folder / TIMES)
    else:
        notes.append(f"no {TIMES} in {folder}: assumed {SECONDS_PER_SCAN:g} s from one scan to the next")
    by_number = {int(pose.key): pose for pose in poses.poses}
    found: list[tuple[Path, float, RecordedPose]] = []
    for file in files:
        number = number_of(file)
        if number not in by_number or (stamps is not None and number >= len(stamps)):
            continue
        stamp = SECONDS_PER_SCAN * number if stamps is None else stamps[number]
        found.append((file, stamp, by_number[number]))
    undo = options.conventions
    with naming(str(folder)):
        world = in_world(
            len(found),
            lambda i: pose_of(_pose(found[i][2], T_camera_lidar), undo),
            lambda i: read_cloud(found[i][0]),
        )
    if world:
        notes.append(
            "points are in the world's frame: clouds fit together as they are; rays begin at the poses"
        )
    scans = [
        RecordedScan(
            file.stem, stamp, partial(_pose, pose, T_camera_lidar), pose.source,
            partial(_points, file, world, undo), str(file),
        )
        for file, stamp, pose in found
    ]  # fmt: skip
    dropped = len(files) - len(scans)
    if not scans:
        raise DatasetError(f"{poses.path}: has a pose for none of the {len(files)} scans in {folder / SCANS}")
    if dropped:
        notes.append(
            f"{dropped} of {len(files)} scans dropped: {poses.path.name} or {TIMES} ends before them"
        )
    return lidar_scans(folder.name, scans, notes, dropped, options)


def read_calibration(path: Path) -> Pose:
    """T_camera_lidar, (4, 4), of the line ``Tr:``. Raises DatasetError, which names the file."""
    lines = [line.partition(":") for line in read_text(path, DatasetError).splitlines()]
    words = next((rest.split() for name, colon, rest in lines if colon and name.strip() in _TO_CAMERA), None)
    if words is None:
        raise DatasetError(f"{path}: has no line Tr:, the 3 x 4 matrix from the lidar to the camera")
    try:
        return as_pose(np.array([float(word) for word in words]).reshape(3, 4))
    except ValueError:
        raise DatasetError(f"{path}: Tr must be 12 numbers") from None
    except KeyframeError as error:
        raise DatasetError(f"{path}: Tr: {error}") from error


def _scans(folder: Path) -> list[Path]:
    place = folder / SCANS
    found = (
        [path for path in place.iterdir() if path.suffix == ".bin" and is_file(path)]
        if is_folder(place)
        else []
    )
    return sorted(found, key=natural)


def _poses(folder: Path) -> Trajectory:
    places = (folder / POSES, folder.parent.parent / "poses" / f"{folder.name}.txt")
    path = next((place for place in places if is_file(place)), None)
    if path is None:
        raise DatasetError(
            f"{folder}: no poses of its scans; looked for {POSES} and ../../poses/{folder.name}.txt"
        )
    trajectory = read_trajectory(path)
    if trajectory.layout == "stamped":
        raise DatasetError(f"{path}: expected a 3 x 4 matrix, row by row, in each line, or behind its number")
    return trajectory


def _pose(pose: RecordedPose, T_camera_lidar: Pose) -> Pose:
    """T_world_lidar."""
    return inverse(T_camera_lidar) @ pose.T_world_camera() @ T_camera_lidar


def _points(
    file: Path, world: bool | None, conventions: Conventions, T_recorded: Pose
) -> NDArray[np.float64]:
    points_m = read_cloud(file)
    return of_sensor(points_m, pose_of(T_recorded, conventions)) if world else points_m
