"""Lidar scans as frames: the reader behind every format of point clouds.

A format only lists its scans; a scan's points are read and checked here. Points of an unknown pattern become
free rays, one for each point, so every frame has a camera of its own, and depth is range.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table
from taichi_mrf.datasets.lidar.recording import LidarRecording
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

SECONDS_PER_SCAN = 0.1
"""Assumed where nothing tells: most lidars turn ten times a second."""


@dataclass(frozen=True)
class RecordedScan(Row):
    """One scan of a recording, whose pose is T_world_sensor.

    ``read_points`` gives its points (N, 3) in metres in the sensor's frame, of which it gets the pose, NaN
    and 0 where nothing came back; ``source`` is their file. ``starts`` gives the places (N, 3) in that frame
    from which they were measured, None if that is its pose. Both raise DatasetError, which names the file.
    """

    read_points: Callable[[Pose], NDArray[np.float64]]
    source: str
    starts: Callable[[], NDArray[np.float64]] | None = None


@dataclass
class LidarScans(LidarRecording, Table[RecordedScan]):
    """Scans of free rays. ``camera`` and ``reach_m`` are those of the first scan that can be read."""

    def load(self, index: int, row: RecordedScan, T_world_camera: Pose) -> Frame:
        """The rays of a scan's measured points, of which there must be one, and their ranges (1, N)."""
        points_m = row.read_points(T_world_camera)
        starts_m = np.zeros((1, 3)) if row.starts is None else row.starts()
        measured = measured_points(points_m - starts_m)
        if not measured.any():
            raise DatasetError(f"{row.source}: none of {len(points_m)} points is a measurement")
        if row.starts is None:
            table, range_m = RayTable.of_points(points_m[measured])
        else:
            T_sensor_then = np.tile(np.eye(4), (int(measured.sum()), 1, 1))
            T_sensor_then[:, :3, 3] = starts_m[measured]
            table, range_m = RayTable.of_points((points_m - starts_m)[measured], T_sensor_then)
        return Frame(range_m, T_world_camera, table, row.stamp, row.name)


def measured_points(points_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which points (..., 3) in the sensor's frame are measurements: not NaN, not infinite and not 0."""
    with np.errstate(over="ignore", invalid="ignore"):
        range_m = np.linalg.norm(points_m.astype(np.float64), axis=-1).astype(np.float32)
    return np.isfinite(range_m) & (range_m > 0)


def lidar_scans(
    name: str, scans: Sequence[RecordedScan], notes: Sequence[str], dropped: int, options: ReadOptions
) -> LidarScans:
    """The recording of these scans. Raises DatasetError if none can be read, which is the first one's error,
    and for options that only depth images have."""
    refuse_image_options(name, options)
    found = LidarScans(name, RayTable([[1.0, 0.0, 0.0]]), list(notes), dropped, rows=scans)
    found.look_at_first("scan")
    return found


def refuse_image_options(name: str, options: ReadOptions) -> None:
    """Raise DatasetError, in one sentence, for options that only depth images have."""
    asked = {
        "--camera": options.camera is not None or options.intrinsics is not None,
        "--depth-scale": options.depth_scale is not None,
        "--undistort": options.undistort is not None,
        "--image-scale": options.image_scale != 1.0,
    }
    wrong = [flag for flag, is_asked in asked.items() if is_asked]
    if wrong:
        raise DatasetError(f"{name}: contains lidar scans; {', '.join(wrong)} is for depth images")
