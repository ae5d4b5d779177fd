"""Lidar scans as frames: the reader behind every format of point clouds.

A format only lists its scans; a scan's points are read and checked here. Points of an unknown pattern become
free rays, one for each point, so every frame has a camera of its own, and depth is range. What every lidar's
recording says of its sensor is here too.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, Row, StatedSensor, Table
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

LIDAR_SIGMA_M = 0.03
"""Standard deviation of range that is assumed: spinning lidars are specified with 2 to 3 cm at all ranges."""

LIDAR_PASS_THROUGH = 0.1
"""Chance that a beam passes an occupied voxel. A lidar's voxels are wide, so posts and legs fill only a part
of one (docs/decisions.md)."""

_REACH_STEP_M, MOST_REACH_M = 10.0, 500.0


@dataclass
class LidarRecording(Dataset):
    """The scans of a lidar. ``reach_m`` is the largest range of the first one, None until that is read."""

    reach_m: float | None = field(default=None, kw_only=True)

    def look_at_first(self, what: str) -> None:
        """Set camera and reach from the first scan (``what``) that can be read. Raises DatasetError, which
        says why the first cannot, if none can."""
        problem: FrameError | None = None
        for index in range(len(self)):
            try:
                frame = self.read(index)
            except FrameError as error:
                problem = problem or error
                continue
            self.camera, self.reach_m = frame.camera, reach_of(frame.depth_m)
            return
        raise DatasetError(f"{self.name}: no {what} can be read: {problem}") from problem

    @property
    def stated(self) -> StatedSensor:
        """Facts that are assumed for every lidar, and the largest range of the first scan."""
        return StatedSensor(
            (LIDAR_SIGMA_M,),
            origin="assumed for a lidar",
            reach_m=self.reach_m,
            pass_through=LIDAR_PASS_THROUGH,
        )


def reach_of(range_m: NDArray[np.floating]) -> float:
    """How far ranges, 0 for none, go: all but the thousandth of them that may be damaged, rounded up to tens
    of metres, and at most MOST_REACH_M. Warns if most go further."""
    median_m = float(np.median(range_m[range_m > 0]))
    if median_m > MOST_REACH_M:
        warnings.warn(
            f"half of the points of the first scan are further than {median_m:.0f} m: points are read as "
            "metres, so divide them by 1000 if they are millimetres; else set sensor.max_depth",
            stacklevel=3,
        )
    reach_m = np.quantile(range_m[range_m > 0], 0.999)
    return float(min(max(1.0, np.ceil(reach_m / _REACH_STEP_M)) * _REACH_STEP_M, MOST_REACH_M))


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
