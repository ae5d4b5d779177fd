"""A lidar moves while it measures: its points, taken to where they were measured and back into one frame."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M
from taichi_mrf.datasets.timed_poses import interpolate
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms

PoseAt = Callable[[float], Pose | None]
"""T_world_lidar, (4, 4), at a time in seconds, None if it is not known."""

_FAR_M = 10.0
_LOOKED_UP, _POSES_A_SCAN = 16, 1024
"""Poses are looked up so many times during a scan, and interpolated for so many columns."""


def without_motion(
    points_m: NDArray[np.float64], seconds: NDArray[np.float64], stamp: float, T_world_lidar: Pose, at: PoseAt
) -> NDArray[np.float64] | None:
    """Points (N, 3) in the lidar's frame, measured ``seconds`` (N,) after the stamp, in its frame at the
    stamp, where its pose is ``T_world_lidar``. None if it moved less than its noise, or not all poses are
    known."""
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
