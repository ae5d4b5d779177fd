"""A bag's point clouds as lidar scans: ``walk.mcap?points=/points&pose=/odom``.

A cloud that is an image of beams and columns, or whose rings can be put together to one, becomes an image,
whose pixels without a return are known; any other becomes free rays. Where each point has a time, and the
lidar moved meanwhile, each ray starts where the lidar was at that time.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Table
from taichi_mrf.datasets.lidar.motion import Motion, Scan
from taichi_mrf.datasets.lidar.organised import by_ring, organised
from taichi_mrf.datasets.lidar.scans import LidarRecording, measured_points
from taichi_mrf.datasets.ros.point_cloud import Cloud, decode
from taichi_mrf.datasets.ros.reader import BagRow, RosReader
from taichi_mrf.errors import DatasetError, naming
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable


@dataclass
class LidarBag(LidarRecording, Table[BagRow]):
    """The point clouds of one topic, each with its pose. ``at`` gives the pose of the lidar of a frame at a
    time in seconds, or None; if it is None itself, points are left where they are. ``registered`` points are
    in the world's frame, and are taken back into the lidar's."""

    reader: RosReader = field(kw_only=True)
    topic: str = field(kw_only=True)
    at: Callable[[str, float], Pose | None] | None = None
    registered: bool = False

    def load(self, index: int, row: BagRow, T_world_camera: Pose) -> Frame:
        """Decode one cloud, which must have a measurement."""
        message, entry = self.reader.read(self.topic, row.entry), row.entry
        with naming(f"{self.reader.path}: topic {self.topic}"):
            cloud = decode(message, entry.stamp)
            measured = measured_points(cloud.points_m)
            if not measured.any():
                raise DatasetError(f"none of {measured.size} points is a measurement")
        pose = T_world_camera
        if self.registered:
            own = (cloud.points_m.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
            cloud = replace(cloud, points_m=own.astype(cloud.points_m.dtype))
        motion = None if self.at is None else Motion(entry.stamp, pose, partial(self.at, entry.frame))
        scan = _image(cloud, motion) or _free(cloud, motion)
        return Frame(scan.range_m, pose, scan.camera, entry.stamp, row.name, no_return=scan.no_return)

    def look_at_first(self, what: str = "cloud") -> None:
        """Set camera, reach and a note from the first cloud that can be read. Raises DatasetError as for any
        lidar."""
        super().look_at_first(what)
        pattern = isinstance(self.camera, RayTable) and self.camera.has_pattern
        rays = f"images of {self.camera.width} x {self.camera.height} rays" if pattern else "free rays"
        self.notes.append(f"{self.topic}: {rays}")


def _image(cloud: Cloud, motion: Motion | None) -> Scan | None:
    """The image of a cloud with rows or rings, None for any other."""
    points = cloud.points_m.reshape(-1, 3)
    numbers: NDArray[np.intp] = np.arange(len(points)).reshape(cloud.points_m.shape[:2])
    if len(cloud.points_m) == 1 and cloud.ring is not None:
        rings = by_ring(points, cloud.ring[0])
        numbers = numbers if rings is None else rings
    found = organised(points[numbers])
    if found is None:
        return None
    scan, order = found
    if motion is None or cloud.seconds is None:
        return scan
    seconds = cloud.seconds.reshape(-1)[numbers.reshape(-1)[order]]
    return motion.of_image(scan, seconds, (scan.range_m > 0) & np.isfinite(seconds)) or scan


def _free(cloud: Cloud, motion: Motion | None) -> Scan:
    """A cloud as free rays."""
    measured, poses = measured_points(cloud.points_m), None
    if motion is not None and cloud.seconds is not None:
        poses = motion.poses(cloud.seconds[measured])
    return Scan(*RayTable.of_points(cloud.points_m[measured], poses), None)
