"""The JSON files of Open3D: a camera's intrinsics, and trajectories of cameras.

Open3D writes matrices column by column. A PinholeCameraTrajectory has for each image its intrinsics and its
``extrinsic``, T_camera_world; a PoseGraph has for each node its ``pose``, T_world_camera.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf.datasets.trajectories import RecordedPose, Trajectory
from taichi_mrf.errors import ConfigError, DatasetError, KeyframeError, said
from taichi_mrf.geometry.poses import as_pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

_LISTS = {"PinholeCameraTrajectory": "parameters", "PoseGraph": "nodes"}


def read_intrinsics(path: Path) -> PinholeCamera:
    """The camera of a PinholeCameraIntrinsic file. Raises DatasetError, whose text names the file."""
    return _camera(path, _values(path))


def is_trajectory_json(path: Path) -> bool:
    """True if a file is JSON of one of the two kinds of trajectory."""
    try:
        return _values(path).get("class_name") in _LISTS
    except (DatasetError, AttributeError):
        return False


def read_trajectory_json(path: Path) -> Trajectory:
    """The poses of a trajectory, counted from 0, with the cameras of their images where it holds some.

    Raises DatasetError, whose text names the file and the entry, if a matrix is missing or has not 16
    numbers, or if there is no entry.
    """
    values = _values(path)
    entries = values.get(_LISTS[values["class_name"]])
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f"{path}: contains no pose")
    return Trajectory(path, "log", tuple(_pose(path, index, entry) for index, entry in enumerate(entries)))


def _pose(path: Path, index: int, entry: Any) -> RecordedPose:
    source = f"{path} entry {index}"
    try:
        name = "pose" if "pose" in entry else "extrinsic"
        matrix = np.array(entry[name], np.float64).reshape(4, 4).T
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DatasetError(f"{source}: needs the 16 numbers of a pose or an extrinsic") from None
    if name == "extrinsic":
        try:
            matrix = inverse(as_pose(matrix))
        except KeyframeError:
            matrix = np.full((4, 4), np.nan)  # reported when its frame is read
    intrinsic = entry.get("intrinsic")
    # A focal length of zero stands for a camera that is not known.
    unknown = intrinsic is None or (isinstance(intrinsic, dict) and _focal(intrinsic) == 0)
    return RecordedPose(index, matrix, source, None if unknown else _camera(source, intrinsic))


def _focal(intrinsic: dict[str, Any]) -> Any:
    matrix = intrinsic.get("intrinsic_matrix")
    return matrix[0] if isinstance(matrix, list) and matrix else None


def _camera(path: Path | str, values: Any) -> PinholeCamera:
    try:
        width, height = int(values["width"]), int(values["height"])
        matrix = np.array([float(value) for value in values["intrinsic_matrix"]]).reshape(3, 3)
        by_rows = matrix[2].tolist() == [0, 0, 1]  # as they are written by hand
        return PinholeCamera.from_matrix(width, height, matrix if by_rows else matrix.T)
    except ConfigError as error:
        raise DatasetError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DatasetError(
            f"{path}: an intrinsic needs width, height and the 9 numbers of intrinsic_matrix"
        ) from None


def _values(path: Path) -> Any:
    text = read_text(path, DatasetError)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not valid JSON: {said(error)}") from error
