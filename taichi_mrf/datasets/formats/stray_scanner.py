"""Recordings of the app Stray Scanner: an iPhone's or iPad's lidar, with ARKit's poses and confidence.

- ``depth/NNNNNN.png``: 16-bit millimetres, 256 x 192
- ``confidence/NNNNNN.png``: 8-bit, ARKit's levels 0 (low), 1 and 2 (high)
- ``camera_matrix.csv``: the 3 x 3 matrix of the colour camera at 1920 x 1440 pixels, to which depth is
registered
- ``odometry.csv``: with a header; the columns timestamp, frame, x, y, z, qx, qy, qz, qw are T_world_camera;
fx, fy, cx, cy, where there are some, are each frame's in place of the matrix

Level 2 leaves the sigma, level 1 doubles it, and pixels of level 0 are no measurements. The colour images are
a film, which is not read.
"""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.confidence import ARKIT
from taichi_mrf.datasets.intrinsics import own_cameras
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.recording import RecordedFrame, first_file, recording
from taichi_mrf.datasets.trajectories import RecordedPose
from taichi_mrf.errors import ConfigError, DatasetError, naming
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

NAME = "Stray Scanner"
DEPTH, CONFIDENCE, MATRIX, ODOMETRY = "depth", "confidence", "camera_matrix.csv", "odometry.csv"
COLOR_SIZE, DEPTH_WIDTH = (1920, 1440), 256
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the images that have a pose, in the order of their numbers. Raises DatasetError, which names the
    file and the line."""
    images = {int(p.stem): p for p in (folder / DEPTH).iterdir() if p.suffix == ".png" and p.stem.isdecimal()}
    poses = _read_odometry(folder / ODOMETRY)
    frames = []
    posed = sorted(images.keys() & poses.keys())
    own = own_cameras([poses[number].camera for number in posed], options)
    for number, camera in zip(posed, own, strict=True):
        path, pose = images[number], poses[number]
        files = path, None, first_file([folder / CONFIDENCE / path.name])
        frames.append(
            RecordedFrame(path.stem, pose.key, pose.T_world_camera, pose.source, *files, camera=camera)
        )
    if not frames:
        raise DatasetError(f"{folder / ODOMETRY}: has a pose for none of the {len(images)} images in {DEPTH}")
    camera, why = options.camera or own[0] or _camera(folder / MATRIX), f"{ODOMETRY} has no pose for them"
    depth_alone = replace(options, color=False)
    return recording(
        folder, depth_alone, camera, frames, 1000.0, NAME, [], len(images), why, confidence=ARKIT
    )


def _camera(path: Path) -> PinholeCamera:
    """The depth camera, from the matrix of the colour camera."""
    try:
        rows = [
            [float(word) for word in row]
            for row in csv.reader(read_text(path, DatasetError).splitlines())
            if row
        ]
        matrix = np.array(rows)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError
    except ValueError:
        raise DatasetError(f"{path}: expected a 3 x 3 matrix of numbers, with commas between them") from None
    with naming(path, ConfigError):
        return PinholeCamera.from_matrix(*COLOR_SIZE, matrix).scaled(DEPTH_WIDTH / COLOR_SIZE[0])


def _read_odometry(path: Path) -> dict[int, RecordedPose]:
    """The pose of each frame by its number."""
    lines = list(csv.reader(read_text(path, DatasetError).splitlines()))
    names = [name.strip() for name in lines[0]] if lines else []
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        raise DatasetError(f"{path}: its first line lacks the column {', '.join(missing)}")
    places = [names.index(name) for name in _COLUMNS]
    own = [names.index(name) for name in _INTRINSICS if name in names]
    poses = {}
    for number, words in enumerate(lines[1:], start=2):
        if not words:
            continue
        try:
            stamp, frame, *values = (float(words[place]) for place in places)
            camera = _own_camera([float(words[place]) for place in own])
            poses[int(frame)] = RecordedPose(stamp, np.array(values), f"{path} line {number}", camera)
            if not np.isfinite(stamp):
                raise ValueError
        except (ValueError, IndexError, OverflowError):
            raise DatasetError(f"{path} line {number}: expected {len(names)} numbers") from None
    return poses


def _own_camera(intrinsics: list[float]) -> PinholeCamera | None:
    """The depth camera of one frame; None if its intrinsics are not known, for which zeros stand too."""
    try:
        own = PinholeCamera(*COLOR_SIZE, *intrinsics) if len(intrinsics) == len(_INTRINSICS) else None
    except ConfigError:
        return None
    return own and own.scaled(DEPTH_WIDTH / COLOR_SIZE[0])
