"""A bag's point clouds as lidar scans: ``walk.mcap?points=/points&pose=/odom``.

A cloud that is an image of beams and columns, or whose rings can be put together to one, becomes an image,
whose pixels without a return are known; any other becomes free rays. Where each point has a time, and the
lidar moved meanwhile, each ray starts where the lidar was at that time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.motion import Motion, PoseAt, Scan
from taichi_mrf.datasets.lidar.organised import by_ring, organised
from taichi_mrf.datasets.lidar.recording import LidarRecording, reach_of
from taichi_mrf.datasets.lidar.scans import measured_points
from taichi_mrf.datasets.ros.point_cloud import Cloud, decode
from taichi_mrf.datasets.ros.reader import Entry, RosReader
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable


@dataclass
class LidarBag(LidarRecording):
    """The point clouds of one topic, each with its pose. ``at`` gives the lidar's pose at a time in seconds,
    or None; if it is None itself, points are left where they are. ``registered`` points are in the world's
    frame, and are taken back into the lidar's."""

    reader: RosReader = field(kw_only=True)
    topic: str = field(kw_only=True)
    entries: Sequence[Entry] = field(kw_only=True)
    poses: Sequence[Pose] = field(kw_only=True)
    names: Sequence[str] = field(kw_only=True)
    at: PoseAt | None = None
    registered: bool = False

    @property
    def frame_names(self) -> Sequence[str]:
        """The number that each cloud has in its topic, from 0."""
        return self.names

    def stamps(self) -> Sequence[float]:
        """When each frame was taken, in seconds."""
        return [entry.stamp for entry in self.entries]

    def pose(self, index: int) -> Pose:
        """The pose of one frame."""
        return self.poses[index]

    def read(self, index: int) -> Frame:
        """Decode one cloud.

        Raises FrameError, which names frame, file and topic, if it is damaged or has no measurement. Raises
        IndexError outside 0 to len - 1.
        """
        if not 0 <= index < len(self.entries):
            raise IndexError(f"{self.name} has {len(self.entries)} frames, there is no frame {index}")
        name, where, entry = self.names[index], f"{self.reader.path}: topic {self.topic}", self.entries[index]
        try:
            message = self.reader.read(self.topic, entry)
        except DatasetError as error:
            raise FrameError(f"frame {name}: {error}") from error
        try:
            cloud = decode(message, entry.stamp)
        except DatasetError as error:
            raise FrameError(f"frame {name}: {where}: {error}") from error
        measured = measured_points(cloud.points_m)
        if not measured.any():
            raise FrameError(f"frame {name}: {where}: none of {measured.size} points is a measurement")
        pose = self.poses[index]
        if self.registered:
            own = (cloud.points_m.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
            cloud = replace(cloud, points_m=own.astype(cloud.points_m.dtype))
        motion = None if self.at is None else Motion(entry.stamp, pose, self.at)
        scan = _image(cloud, motion) or _free(cloud, motion)
        return Frame(scan.range_m, pose, scan.camera, entry.stamp, name, no_return=scan.no_return)

    def look_at_first(self) -> None:
        """Set camera, reach and notes from the first cloud that can be read. Raises DatasetError, which says
        why the first cannot, if none can."""
        problem: FrameError | None = None
        for index in range(len(self.entries)):
            try:
                frame = self.read(index)
            except FrameError as error:
                problem = problem or error
                continue
            self.camera, self.reach_m = frame.camera, reach_of(frame.depth_m)
            pattern = isinstance(frame.camera, RayTable) and frame.camera.has_pattern
            rays = f"images of {frame.camera.width} x {frame.camera.height} rays" if pattern else "free rays"
            self.notes.append(f"{self.topic}: {rays}")
            return
        raise DatasetError(f"{self.name}: no cloud can be read: {problem}") from problem


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
