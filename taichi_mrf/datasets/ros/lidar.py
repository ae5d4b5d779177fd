"""A bag's point clouds as lidar scans: ``walk.mcap?points=/points&pose=/odom``.

A cloud that is an image of beams and columns, or whose rings can be put together to one, becomes an image,
whose pixels without a return are known; any other becomes free rays. Where each point has a time, and the
lidar moved meanwhile, points are taken to where they were measured, by the poses at their times, and back
into the lidar's frame at the stamp of the scan.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.lidar.organised import by_ring, organised
from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M, measured_points, noise_note, reach_of
from taichi_mrf.datasets.ros.point_cloud import Cloud, decode
from taichi_mrf.datasets.ros.reader import Entry, RosReader
from taichi_mrf.datasets.timed_poses import interpolate
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.ray_table import RayTable

_FAR_M = 10.0
_LOOKED_UP, _POSES_A_SCAN = 16, 1024
"""Poses are looked up so many times during a scan, and interpolated for so many columns."""


@dataclass
class LidarBag(Dataset):
    """The point clouds of one topic, each with its pose. ``at`` gives the lidar's pose at a time in seconds,
    or None; if it is None itself, points are left where they are."""

    reader: RosReader = field(kw_only=True)
    topic: str = field(kw_only=True)
    entries: Sequence[Entry] = field(kw_only=True)
    poses: Sequence[Pose] = field(kw_only=True)
    names: Sequence[str] = field(kw_only=True)
    at: Callable[[float], Pose | None] | None = None
    reach_m: float | None = None

    @property
    def frame_names(self) -> Sequence[str]:
        """The number that each cloud has in its topic, from 0."""
        return self.names

    @property
    def recorded_sigma(self) -> tuple[float, ...] | None:
        """A lidar's, the same at every range."""
        return (LIDAR_SIGMA_M,)

    @property
    def recorded_reach(self) -> float | None:
        """The largest range of the first cloud, rounded up to tens of metres."""
        return self.reach_m

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
        moved = _unmoved(cloud, measured, pose, entry.stamp, self.at)
        camera, range_m, no_return = _rays(cloud) if moved is None else _free(moved)
        return Frame(range_m, pose, camera, entry.stamp, name, no_return=no_return)

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
            self.notes += [f"{self.topic}: {rays}", noise_note(self.reach_m)]
            return
        raise DatasetError(f"{self.name}: no cloud can be read: {problem}") from problem


Rays = tuple[Camera, NDArray[np.float32], "NDArray[np.bool_] | None"]


def _rays(cloud: Cloud) -> Rays:
    """The image of a cloud, or its free rays."""
    image: NDArray[np.floating] = cloud.points_m
    if image.shape[0] == 1 and cloud.ring is not None:
        rings = by_ring(image[0], cloud.ring[0])
        image = image if rings is None else rings
    found = organised(image)
    return _free(cloud.points_m.reshape(-1, 3)) if found is None else found


def _free(points_m: NDArray[np.float64]) -> Rays:
    table, range_m = RayTable.of_points(points_m[measured_points(points_m)])
    return table, range_m, None


def _unmoved(
    cloud: Cloud,
    measured: NDArray[np.bool_],
    T_world_lidar: Pose,
    stamp: float,
    at: Callable[[float], Pose | None] | None,
) -> NDArray[np.float64] | None:
    """The measured points (N, 3), in the lidar's frame at the stamp, without the motion during the scan. None
    if it did not move enough to matter, or if nothing tells."""
    if at is None or cloud.seconds is None:
        return None
    points_m, seconds = cloud.points_m[measured], cloud.seconds[measured]
    if not np.isfinite(seconds).all() or seconds.max() == seconds.min():
        return None
    first, last = float(seconds.min()), float(seconds.max())
    poses = [at(stamp + time) for time in np.linspace(first, last, _LOOKED_UP)]
    known = [pose for pose in poses if pose is not None]
    if len(known) < _LOOKED_UP:
        return None
    rotation, translation = tangent_norms(known[0], known[-1])
    if _FAR_M * rotation + translation < LIDAR_SIGMA_M:
        return None
    T_lidar_world = inverse(T_world_lidar)
    T_lidar_then = np.array([T_lidar_world @ pose for pose in known])
    place = np.linspace(0, _LOOKED_UP - 1, _POSES_A_SCAN)
    before = np.minimum(place.astype(int), _LOOKED_UP - 2)
    T = interpolate(T_lidar_then[before], T_lidar_then[before + 1], place - before)
    column = np.rint((seconds - first) / (last - first) * (_POSES_A_SCAN - 1)).astype(int)
    turned: NDArray[np.float64] = np.einsum("nij,nj->ni", T[column, :3, :3], points_m)
    return turned + T[column, :3, 3]
