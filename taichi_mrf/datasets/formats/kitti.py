"""KITTI's odometry layout (A. Geiger, P. Lenz and R. Urtasun, CVPR 2012): rectified stereo pairs, or the
scans of a velodyne.

Stereo pairs:

- ``image_l`` and ``image_r`` (or ``image_0`` and ``image_1``): a pair has one numbered name in both
- ``calib.txt``: the 3 x 4 projections P0 and P1 of the left and right camera, row by row, 12 numbers each: in
  lines that begin with ``P0:`` and ``P1:``, else in the first two lines. P1 is K [I | (-b, 0, 0)], baseline b
- ``poses.txt``: for each pair the 3 x 4 matrix from the left camera to the first left camera, so the world
  has that camera's axes: y down, z forward
- ``times.txt``: for each pair its stamp in seconds; without it the pairs are KITTI's 0.1 s apart

Scans; their folder ``velodyne`` may be named in place of the sequence's:

- ``velodyne/NNNNNN.bin``: x y z and reflectance of each point, float32, in the lidar's frame (z up)
- ``calib.txt``: the 3 x 4 matrix ``Tr``, which takes the lidar's points to the left camera
- ``poses.txt``, or ``../../poses/NN.txt``: for each scan the 3 x 4 pose of the left camera
- ``times.txt``: for each scan its stamp in seconds; without it scans are 0.1 s apart

The world of scans is the frame of the lidar at the first pose, as SemanticKITTI has it: T_world_lidar is
Tr^-1 P Tr.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.derived import pose_of
from taichi_mrf.datasets.entries import velodyne_sequence
from taichi_mrf.datasets.lidar.clouds import layout_notes, read_cloud
from taichi_mrf.datasets.lidar.registered import in_world, read_of_sensor
from taichi_mrf.datasets.lidar.scans import SECONDS_PER_SCAN, RecordedScan, lidar_scans
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.recording import natural, number_in
from taichi_mrf.datasets.stereo.matching import (
    RecordedPair,
    StereoPairs,
    StereoRig,
    noise_note,
    read_times,
    size_of_pairs,
)
from taichi_mrf.datasets.trajectories import RecordedPose, Trajectory, floats, read_trajectory
from taichi_mrf.errors import ConfigError, DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, as_pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import is_file, is_folder, read_text

SCANS = "velodyne"
_TO_CAMERA = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")


def open_scans(path: Path, options: ReadOptions) -> Dataset:
    """List the scans in the order of their numbers. Raises DatasetError, which names the file and line."""
    folder = velodyne_sequence(path)
    assert folder is not None
    every = (folder / SCANS).iterdir() if is_folder(folder / SCANS) else ()
    files = sorted((file for file in every if file.suffix == ".bin" and is_file(file)), key=natural)
    T_camera_lidar = read_calibration(folder / CALIBRATION)
    poses = _poses_of_scans(folder)
    notes, stamps = [], None
    if is_file(folder / TIMES):
        stamps = read_times(folder / TIMES)
    else:
        notes.append(f"no {TIMES} in {folder}: assumed {SECONDS_PER_SCAN:g} s from one scan to the next")
    by_number = {int(pose.key): pose for pose in poses.poses}
    found: list[tuple[Path, float, RecordedPose]] = []
    for file in files:
        number = number_in(file.stem)
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
            partial(read_of_sensor, partial(read_cloud, file), world, undo), str(file),
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
    notes += layout_notes([file for file, _, _ in found])
    return lidar_scans(folder.name, scans, notes, dropped, options)


def read_calibration(path: Path) -> Pose:
    """T_camera_lidar, (4, 4), of the line ``Tr:``. Raises DatasetError, which names the file."""
    words = next((words for name, words in _labelled(path).items() if name in _TO_CAMERA), None)
    if words is None:
        raise DatasetError(f"{path}: has no line Tr:, the 3 x 4 matrix from the lidar to the camera")
    try:
        matrix = np.array([float(word) for word in words]).reshape(3, 4)
    except ValueError:
        raise DatasetError(f"{path}: Tr must be 12 numbers") from None
    with naming(f"{path}: Tr", KeyframeError):
        return as_pose(matrix)


def _poses_of_scans(folder: Path) -> Trajectory:
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


FOLDERS = (("image_l", "image_r"), ("image_0", "image_1"))
CALIBRATION, POSES, TIMES = "calib.txt", "poses.txt", "times.txt"
SECONDS_PER_FRAME = 0.1
IMAGE_SUFFIXES = (".png", ".jpg", ".pgm")

_SAME = 1e-6
"""Largest difference, relative to the focal length, of matrix entries that count as equal."""


def open_pairs(folder: Path, options: ReadOptions) -> Dataset:
    """List the pairs in the order of their names. One that lacks an image raises an error when it is read."""
    if options.depth_scale is not None:
        raise DatasetError(f"{folder}: takes no depth_scale: depth comes from stereo pairs")
    left, right = next(pair for pair in FOLDERS if all((folder / side).is_dir() for side in pair))
    every = _images(folder / left) | _images(folder / right)
    names = sorted(every, key=lambda name: (int(Path(name).stem), name))
    if not names:
        raise DatasetError(f"{folder}: no numbered images in {left} or {right}")
    rig = _read_rig(folder, left, names, options)
    poses = read_trajectory(_needed(folder / POSES))
    if poses.layout != "rows":
        raise DatasetError(f"{poses.path}: expected a 3 x 4 matrix, row by row, in each line")
    stamps, stamp_notes = _stamps(folder / TIMES, len(names))
    for path, what, count in (
        (poses.path, "poses", len(poses.poses)),
        (folder / TIMES, "stamps", len(stamps)),
    ):
        if count != len(names):
            raise DatasetError(f"{path}: contains {count} {what} for {len(names)} stereo pairs")
    pairs = []
    for name, stamp, pose in zip(names, stamps, poses.poses, strict=True):
        images = folder / left / name, folder / right / name
        pairs.append(RecordedPair(images[0].stem, stamp, pose.T_world_camera, pose.source, *images))
    return StereoPairs(
        name=folder.name,
        camera=rig.camera,
        notes=[noise_note(rig, left, right), *stamp_notes],
        rows=pairs,
        baseline_m=rig.baseline_m,
        color=options.color,
    )


def _images(folder: Path) -> set[str]:
    """Names of the image files that are a number."""
    return {p.name for p in folder.iterdir() if p.stem.isdecimal() and p.suffix.lower() in IMAGE_SUFFIXES}


def _needed(path: Path) -> Path:
    if not path.is_file():
        raise DatasetError(f"{path}: is missing; a stereo recording needs {CALIBRATION} and {POSES}")
    return path


def _read_rig(folder: Path, left: str, names: Sequence[str], options: ReadOptions) -> StereoRig:
    calibration = _needed(folder / CALIBRATION)
    if options.camera is not None:
        recorded = read_rig(calibration, options.camera.width, options.camera.height)
        return StereoRig(options.camera, recorded.baseline_m)
    recorded = read_rig(calibration, *size_of_pairs(folder / left, (folder / left / name for name in names)))
    if options.intrinsics is None:
        return recorded
    camera = PinholeCamera(recorded.camera.width, recorded.camera.height, *options.intrinsics)
    return StereoRig(camera, recorded.baseline_m)


def _stamps(path: Path, count: int) -> tuple[list[float], list[str]]:
    """Each pair's stamp in seconds, and a note where they are assumed."""
    if not path.is_file():
        note = f"no {TIMES} in {path.parent}: assumed {SECONDS_PER_FRAME:g} s from one pair to the next"
        return [SECONDS_PER_FRAME * i for i in range(count)], [note]
    return read_times(path), []


def read_rig(path: Path, width: int, height: int) -> StereoRig:
    """The rig of images of ``width`` x ``height`` pixels. Raises DatasetError, which names the file, if it
    cannot be read, lacks P0 or P1, or if these are not two equal pinhole cameras, the first at the origin and
    the second to its right."""
    P_left, P_right = _read_projections(path)
    K = P_left[:, :3]
    fx = K[0, 0]
    if fx <= 0 or K[0, 1] or K[1, 0] or tuple(K[2]) != (0.0, 0.0, 1.0):
        raise DatasetError(
            f"{path}: P0 is not the matrix of a pinhole camera without skew: fx 0 cx 0 / 0 fy cy 0 / 0 0 1 0"
        )
    if np.abs(K - P_right[:, :3]).max() > _SAME * fx:
        raise DatasetError(f"{path}: P0 and P1 differ in focal length or principal point: not rectified")
    if np.abs(P_left[:, 3]).max() > _SAME * fx or np.abs(P_right[1:, 3]).max() > _SAME * fx:
        raise DatasetError(f"{path}: P0 must be at the origin, and P1 moved along x alone")
    with naming(path, ConfigError):
        camera = PinholeCamera(width, height, float(fx), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return StereoRig(camera, baseline_m=-float(P_right[0, 3] / fx))


def _labelled(path: Path) -> dict[str, list[str]]:
    """The words of a calibration's lines by what stands before their colons."""
    lines = [line.partition(":") for line in read_text(path, DatasetError).splitlines()]
    return {name.strip(): rest.split() for name, colon, rest in lines if colon}


def _read_projections(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """P0 and P1, (3, 4) each."""
    lines = [words for line in read_text(path, DatasetError).splitlines() if (words := line.split())]
    rows = _labelled(path) or {f"P{i}": words for i, words in enumerate(lines)}
    return _projection(path, "P0", rows), _projection(path, "P1", rows)


def _projection(path: Path, name: str, rows: dict[str, list[str]]) -> NDArray[np.float64]:
    words = rows.get(name)
    if words is None:
        raise DatasetError(f"{path}: {name} is missing")
    numbers = np.array(floats(words, f"{path}: {name}"))
    if len(numbers) != 12 or not np.isfinite(numbers).all():
        raise DatasetError(
            f"{path}: {name} must be 12 finite numbers (a 3 x 4 matrix), it has {len(numbers)}"
        )
    return numbers.reshape(3, 4)
