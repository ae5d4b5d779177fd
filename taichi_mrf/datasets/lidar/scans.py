"""Lidar scans as frames: the reader behind every format of point clouds.

A format only lists its scans; a scan's points are read and checked here. Points of an unknown pattern become
free rays, one for each point, so every frame has a camera of its own, and depth is range.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.recording import LidarRecording, reach_of
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.errors import DatasetError, FrameError, KeyframeError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

SECONDS_PER_SCAN = 0.1
"""Assumed where nothing tells: most lidars turn ten times a second."""

ScanReader = Callable[[], tuple[NDArray[np.float64], Pose]]
"""Points (N, 3) in metres in the sensor's frame, NaN and 0 where nothing came back, and T_world_sensor,
(4, 4). Raises DatasetError, which names the file, or KeyframeError for an invalid pose."""


@dataclass(frozen=True)
class RecordedScan:
    """One scan of a recording; ``source`` is the file of its points, ``pose_source`` the file, or file and
    line, of its pose. ``starts`` gives the places (N, 3) in the sensor's frame from which the points that it
    reads were measured, None if that is its pose."""

    name: str
    stamp: float
    read: ScanReader
    source: str
    pose_source: str
    starts: Callable[[], NDArray[np.float64]] | None = None


@dataclass
class LidarScans(LidarRecording):
    """Scans of free rays. ``camera`` and ``reach_m`` are those of the first scan that can be read."""

    scans: Sequence[RecordedScan] = field(kw_only=True)

    @property
    def frame_names(self) -> Sequence[str]:
        """The names of the scans in order."""
        return [scan.name for scan in self.scans]

    def stamps(self) -> Sequence[float]:
        """When each frame was taken, in seconds."""
        return [scan.stamp for scan in self.scans]

    def read(self, index: int) -> Frame:
        """Read one scan.

        Raises FrameError, which names the frame and the file, if its points are missing, damaged or none, or
        if its pose is invalid. Raises IndexError outside 0 to len - 1.
        """
        if not 0 <= index < len(self.scans):
            raise IndexError(f"{self.name} has {len(self.scans)} frames, there is no frame {index}")
        scan = self.scans[index]
        table, range_m, T_world_sensor = read_scan(scan)
        return Frame(range_m, T_world_sensor, table, scan.stamp, scan.name)


def read_scan(scan: RecordedScan) -> tuple[RayTable, NDArray[np.float32], Pose]:
    """The rays of a scan's measured points, of which there is one, their ranges (1, N), and T_world_sensor.
    Raises FrameError, which names frame and file."""
    try:
        points_m, T_world_sensor = scan.read()
        starts_m = np.zeros((1, 3)) if scan.starts is None else scan.starts()
    except KeyframeError as error:
        raise FrameError(f"frame {scan.name}: {scan.pose_source}: {error}") from error
    except DatasetError as error:
        raise FrameError(f"frame {scan.name}: {error}") from error
    measured = measured_points(points_m - starts_m)
    if not measured.any():
        raise FrameError(f"frame {scan.name}: {scan.source}: none of {len(points_m)} points is a measurement")
    if scan.starts is None:
        return *RayTable.of_points(points_m[measured]), T_world_sensor
    T_sensor_then = np.tile(np.eye(4), (int(measured.sum()), 1, 1))
    T_sensor_then[:, :3, 3] = starts_m[measured]
    return *RayTable.of_points((points_m - starts_m)[measured], T_sensor_then), T_world_sensor


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
    problem: FrameError | None = None
    for scan in scans:
        try:
            camera, range_m, _ = read_scan(scan)
        except FrameError as error:
            problem = problem or error
            continue
        reach_m = reach_of(range_m)
        return LidarScans(name, camera, list(notes), dropped, scans=scans, reach_m=reach_m)
    raise DatasetError(f"{name}: no scan can be read: {problem}") from problem


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
