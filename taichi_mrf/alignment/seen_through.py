"""Share of a mapped surface that a scan looks through: what gives away a pose that fits by chance.

In a hall of equal bays the walls of a scan may lie on those of the next bay. What stands only there is then
in the way of rays that went on.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.sensor.camera import sees_around

BIN_RAD = np.radians(2.0)
"""Side of the bins of azimuth and elevation in which the nearest and the farthest measurement are kept."""

MARGIN_M, MARGIN = 0.3, 0.03
"""By how much a measurement has to be beyond a surface, in metres and as a share of range."""

THROUGH_M = 0.1
"""The margin in metres for a camera, whose pixels are finer than those bins."""

LEAST_FACING = 0.3
"""Cosine of the largest angle at which a camera's rays meet a surface that counts."""

NEAREST_M, FARTHEST_M = 0.5, 12.0
"""Ranges of the surfaces that count. Further away errors of a heading matter, and bins hold much."""

_ROWS, _COLUMNS = 90, 180


@dataclass(frozen=True)
class Sightlines:
    """The ranges, in metres, of the nearest and the farthest measurement of a scan in each bin; infinite and
    0 where it has none."""

    nearest_m: NDArray[np.float64]
    farthest_m: NDArray[np.float64]

    @staticmethod
    def of(image: DepthImage) -> "Sightlines":
        """Those of a scan."""
        depth = image.to_numpy().astype(np.float64).ravel()
        points = (image.camera.rays().reshape(-1, 3) * depth[:, None])[depth > 0]
        ranges_m = np.linalg.norm(points, axis=1)
        nearest_m, farthest_m = np.full(_ROWS * _COLUMNS, np.inf), np.zeros(_ROWS * _COLUMNS)
        bins = _bins(points, ranges_m)
        np.minimum.at(nearest_m, bins, ranges_m)
        np.maximum.at(farthest_m, bins, ranges_m)
        return Sightlines(nearest_m, farthest_m)

    def seen_through(self, surface: Planes, T_world_camera: Pose) -> float:
        """The share of a mapped surface that a scan taken at a pose (4, 4) looks through, of what it sees or
        looks through."""
        return _share(*self.counts(surface, T_world_camera))

    def counts(self, surface: Planes, T_world_camera: Pose) -> tuple[int, int]:
        """Number of surface cells that it looks through, and number that it sees."""
        points = (surface.points_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        ranges_m = np.linalg.norm(points, axis=1)
        counts = (ranges_m > NEAREST_M) & (ranges_m < FARTHEST_M)
        points, ranges_m = points[counts], ranges_m[counts]
        bins = _bins(points, ranges_m)
        nearest_m, farthest_m = self.nearest_m[bins], self.farthest_m[bins]
        margin_m = MARGIN_M + MARGIN * ranges_m
        measured = farthest_m > 0
        through = measured & (nearest_m > ranges_m + margin_m)
        met = measured & ~through & (farthest_m > ranges_m - margin_m)
        return int(through.sum()), int(met.sum())


def _bins(points: NDArray[np.float64], ranges_m: NDArray[np.float64]) -> NDArray[np.intp]:
    """The number of the bin that each point (N, 3) of the camera frame is in, by its direction."""
    elevation = np.arcsin(np.clip(points[:, 2] / ranges_m, -1.0, 1.0)) + np.pi / 2
    azimuth = np.arctan2(points[:, 1], points[:, 0]) + np.pi
    row = np.minimum((elevation / BIN_RAD).astype(np.intp), _ROWS - 1)
    return row * _COLUMNS + np.minimum((azimuth / BIN_RAD).astype(np.intp), _COLUMNS - 1)


def looked_through(surface: Planes, image: DepthImage, T_world_camera: Pose) -> float:
    """The share of a mapped surface that a camera's image taken at a pose (4, 4) looks through, of what it
    sees or looks through."""
    return _share(*_counts_of_camera(surface, image, T_world_camera))


def through_and_seen(surface: Planes, image: DepthImage, T_world_camera: Pose) -> tuple[int, int]:
    """Number of cells of a mapped surface that any sensor's image looks through, and number that it sees."""
    if sees_around(image.camera):
        return Sightlines.of(image).counts(surface, T_world_camera)
    return _counts_of_camera(surface, image, T_world_camera)


def _share(through: int, seen: int) -> float:
    return through / max(1, through + seen)


def _counts_of_camera(surface: Planes, image: DepthImage, T_world_camera: Pose) -> tuple[int, int]:
    """Surfaces seen at a slant do not count, nor what stands beside the edge of something nearer."""
    points = (surface.points_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    normals = surface.normals @ T_world_camera[:3, :3]
    facing = -(points * normals).sum(axis=1) > LEAST_FACING * np.linalg.norm(points, axis=1)
    seen = image.camera.project(points[facing])
    seen = seen[(seen[:, 2] > NEAREST_M) & (seen[:, 2] < FARTHEST_M)]
    u, v = np.rint(seen[:, :2]).astype(np.intp).T
    depth_m = image.to_numpy()
    nearest_m = cv2.erode(np.where(depth_m > 0, depth_m, np.inf), np.ones((5, 5)))[v, u]
    margin_m = THROUGH_M + MARGIN * seen[:, 2]
    measured = np.isfinite(nearest_m)
    through = measured & (nearest_m > seen[:, 2] + margin_m)
    met = measured & ~through & (nearest_m > seen[:, 2] - margin_m)
    return int(through.sum()), int(met.sum())
