"""A lidar moves while it measures: each column of its image, or each point, gets the pose at its time.

Rows of an image need not be measured together: drivers shift them so that a column is an azimuth, and the end
of a row then holds what was measured first. Such pixels are put beyond the image's other edge, a turn away,
so that time and the sensor's place run on along every row, and neighbours are neighbours.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M
from taichi_mrf.datasets.timed_poses import interpolate
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.sensor.ray_table import RayTable

PoseAt = Callable[[float], Pose | None]
"""T_world_lidar, (4, 4), at a time in seconds, None if it is not known."""

_FAR_M = 10.0
_LOOKED_UP, _POSES_A_SCAN = 16, 1024
"""Poses are looked up so many times during a scan, and interpolated for so many columns."""

_WIDEST = 1.5
"""An image that would become wider than this share has no columns that follow each other in time."""


@dataclass(frozen=True)
class Scan:
    """A lidar's image, all (H, W): the camera of a sensor that stands still, ranges in metres, 0 for none,
    and the pixels without a return."""

    camera: RayTable
    range_m: NDArray[np.float32]
    no_return: NDArray[np.bool_] | None


@dataclass(frozen=True)
class Motion:
    """When and where a lidar measured: the ``stamp`` of a scan in seconds, the lidar's pose then, and its
    pose at any time."""

    stamp: float
    T_world_lidar: Pose
    at: PoseAt

    def poses(self, seconds: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The poses (..., 4, 4) in the lidar's frame at the stamp, at times (...) after it in seconds. None
        if it moved less than its noise, if all times are one, or not all poses are known."""
        if not np.isfinite(seconds).all() or seconds.max() == seconds.min():
            return None
        first, last = float(seconds.min()), float(seconds.max())
        poses = [self.at(self.stamp + time) for time in np.linspace(first, last, _LOOKED_UP)]
        known = [pose for pose in poses if pose is not None]
        if len(known) < _LOOKED_UP:
            return None
        rotation, translation = tangent_norms(known[0], known[-1])
        if _FAR_M * rotation + translation < LIDAR_SIGMA_M:
            return None
        T_lidar_world = inverse(self.T_world_lidar)
        T_lidar_then = np.array([T_lidar_world @ pose for pose in known])
        place = np.linspace(0, _LOOKED_UP - 1, _POSES_A_SCAN)
        before = np.minimum(place.astype(int), _LOOKED_UP - 2)
        T = interpolate(T_lidar_then[before], T_lidar_then[before + 1], place - before)
        column = np.rint((seconds - first) / (last - first) * (_POSES_A_SCAN - 1)).astype(int)
        return T[column]

    def of_image(self, scan: Scan, seconds: NDArray[np.float64], known: NDArray[np.bool_]) -> Scan | None:
        """A scan that was measured at times (H, W) after the stamp, of which some are ``known`` (H, W), with
        the sensor's pose at each pixel. None as for :meth:`poses`. Rays without a pattern take its place if
        columns do not follow each other in time."""
        if not known.any():
            return None
        order = _in_time(seconds, known)
        if order is None:
            measured = (scan.range_m > 0) & known
            poses = self.poses(seconds[measured]) if measured.any() else None
            if poses is None:
                return None
            points = scan.camera.rays()[measured] * scan.range_m[measured, None]
            return Scan(*RayTable.of_points(points, poses), None)
        poses = self.poses(order.seconds)
        if poses is None:
            return None
        rows = np.arange(len(seconds))[:, None]
        camera = RayTable.moving(RayTable(scan.camera.rays()[rows, order.columns]), poses)
        taken = rows, np.where(order.filled, order.columns, 0)
        range_m = np.where(order.filled, scan.range_m[taken], np.float32(0.0))
        no_return = None if scan.no_return is None else order.filled & scan.no_return[taken]
        return Scan(camera, range_m, no_return)


@dataclass(frozen=True)
class _Order:
    """The pixels of an image (H, W) in the order of time: the ``columns`` (W',) from which they come, which
    pixels are ``filled`` (H, W'), and the ``seconds`` (H, W') of all."""

    columns: NDArray[np.intp]
    filled: NDArray[np.bool_]
    seconds: NDArray[np.float64]


def _in_time(seconds: NDArray[np.float64], known: NDArray[np.bool_]) -> _Order | None:
    """How pixels measured at times (H, W) follow each other; None if they do not, column by column."""
    height, width = seconds.shape
    apart = max(1, width // 8)  # times may be those of packets of columns
    steps = (seconds[:, apart:] - seconds[:, :-apart])[known[:, apart:] & known[:, :-apart]] / apart
    step = float(np.median(steps)) if len(steps) else 0.0
    if step == 0.0:
        return None
    column = np.arange(width)
    times = np.where(known, seconds, np.nan)
    begin = float(np.nanmedian(times - step * column))
    for row, is_known in zip(times, known, strict=True):
        there = np.flatnonzero(is_known)
        if len(there):  # other pixels have the time of the nearest one, and the steps to it
            after = np.clip(np.searchsorted(there, column), 1, max(1, len(there) - 1))
            left, right = there[after - 1], there[np.minimum(after, len(there) - 1)]
            nearest = np.where(column - left <= right - column, left, right)
            row[:] = row[nearest] + step * (column - nearest)
        else:
            row[:] = begin + step * column
    turns = np.rint((times - begin - step * column) / (step * width))
    if np.abs(turns).max() > 1:
        return None
    place = column + turns.astype(np.intp) * width
    first, last = int(place.min()), int(place.max())
    if last - first + 1 > _WIDEST * width:
        return None
    places, rows = np.arange(first, last + 1), np.arange(height)[:, None]
    filled = np.zeros((height, len(places)), np.bool_)
    filled[rows, place - first] = True
    begins = np.median(times - step * place, axis=1)
    in_time = begins[:, None] + step * places
    in_time[rows, place - first] = times
    ends = seconds[known].min(), seconds[known].max()
    return _Order(places % width, filled, np.clip(in_time, *ends))
