"""The beams of a scan, sorted by direction, so that those near any direction are found quickly.

wavemap projects a cell into the sensor's image to find the beams around it. Scans come here with any camera,
also as free rays without an image, so the directions of the measured pixels are sorted into bins of elevation
and azimuth. Every beam keeps its true direction.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.sensor.camera import forwards
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.resident import resident
from taichi_mrf.system.types import F32, I32, F32Array, F32Array2, I32Array, IVec4, Template, Vec3

LEAST_STEP_RAD = math.radians(0.4)
"""Bins of beams are no finer than this: to look into an empty one takes as long as to look at a beam."""

NEIGHBOURS = 4
"""Beams that update a voxel at most: the neighbours in an image."""

COARSE_STEP_RAD = math.radians(2.0)
"""Bins by which it is found how far the beams around a direction reach."""

SLACK_RAD = 1e-4
"""By this bins are searched further than asked, because kernels find them by :func:`_fast_atan2`."""


@ti.func
def _fast_atan2(y: F32, x: F32) -> F32:
    """The angle of (x, y), to 2e-5 radians (Abramowitz & Stegun, 4.4.49): every voxel needs two."""
    least, most = ti.min(ti.abs(x), ti.abs(y)), ti.max(ti.abs(x), ti.abs(y))
    t = least / ti.max(most, 1e-30)
    s = t * t
    angle = t * (0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))))
    if ti.abs(y) > ti.abs(x):
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@dataclass(frozen=True)
class Bins(Bundle):
    """Bins of directions: rows of elevation, each with the same number of columns around."""

    step: F32
    """Radians of elevation of a bin."""

    rows: I32
    """From straight down to straight up."""

    columns: I32
    """Around, from azimuth -pi on."""

    @staticmethod
    def of(step_rad: float) -> "Bins":
        """Bins of at least this size."""
        columns = max(1, math.floor(2 * math.pi / step_rad))
        return Bins(step_rad, math.ceil(math.pi / step_rad), columns)

    def numbers(self, units: NDArray[np.float64]) -> NDArray[np.int64]:
        """The bins of directions (N, 3) of length 1, (N,)."""
        elevation = np.arctan2(units[:, 2], np.hypot(units[:, 0], units[:, 1]))
        azimuth = np.arctan2(units[:, 1], units[:, 0])
        row = np.floor((elevation + 0.5 * math.pi) / self.step)
        column = np.floor((azimuth / (2 * math.pi) + 0.5) * self.columns)
        row, column = np.clip(row, 0, self.rows - 1), np.clip(column, 0, self.columns - 1)
        return (row * self.columns + column).astype(np.int64)

    @ti.func
    def around(self, direction: Vec3, angle: F32) -> IVec4:
        """The bins within ``angle`` radians of a direction of length 1: first and last row, first and last
        column. Columns may be negative, and count on from the last."""
        wide = angle + SLACK_RAD
        level = ti.sqrt(direction[0] * direction[0] + direction[1] * direction[1])
        elevation = _fast_atan2(direction[2], level)
        azimuth = _fast_atan2(direction[1], direction[0])
        row = ti.floor((elevation - wide + 0.5 * math.pi) / self.step, ti.i32)
        last_row = ti.floor((elevation + wide + 0.5 * math.pi) / self.step, ti.i32)
        # All around if a pole is among them.
        column, last_column = 0, self.columns - 1
        if ti.abs(elevation) + wide < 0.5 * math.pi - SLACK_RAD:
            share = ti.min(1.0, wide / level)
            half = (
                share * (1.0 + (0.5 * math.pi - 1.0) * share * share) + SLACK_RAD
            )  # no less than its arcsine
            a = ti.floor(((azimuth - half) / (2 * math.pi) + 0.5) * self.columns, ti.i32)
            b = ti.floor(((azimuth + half) / (2 * math.pi) + 0.5) * self.columns, ti.i32)
            if b - a < self.columns:
                column, last_column = a, b
        return IVec4(ti.max(0, row), ti.min(self.rows - 1, last_row), column, last_column)

    @ti.func
    def number(self, row: I32, column: I32) -> I32:
        """The bin of a row and a column of :meth:`around`."""
        wrapped = column
        if column < 0:
            wrapped += self.columns
        elif column >= self.columns:
            wrapped -= self.columns
        return row * self.columns + wrapped


@dataclass(frozen=True)
class Beams(Bundle):
    """The measured beams of a scan. Directions are in the sensor's frame, turned so that z is up."""

    bins: Bins

    starts: I32Array
    """(bins + 1): where the beams of each bin begin."""

    beams: F32Array2
    """(number, 5): direction of length 1; measured range; and the range up to which voxels are updated, in
    metres."""

    number: I32
    """Number of entries that are beams."""

    near: F32
    """Radians around a direction in which there are usually NEIGHBOURS beams."""

    coarse: Bins

    farthest: F32Array
    """(coarse bins): the largest of these ranges, 0 without beams."""

    @ti.func
    def direction(self, i: I32) -> Vec3:
        """Direction of a beam."""
        return Vec3(self.beams[i, 0], self.beams[i, 1], self.beams[i, 2])

    @ti.func
    def reach(self, direction: Vec3, angle: F32, enough: F32) -> I32:
        """True if a beam within ``angle`` radians of a direction of length 1, or one not much further off,
        reaches ``enough`` metres."""
        found = 0
        box = self.coarse.around(direction, angle)
        row = box[0]
        while found == 0 and row <= box[1]:
            column = box[2]
            while found == 0 and column <= box[3]:
                if self.farthest[self.coarse.number(row, column)] >= enough:
                    found = 1
                column += 1
            row += 1
        return found


def upright_axes(image: DepthImage) -> NDArray[np.float64]:
    """The rotation (3, 3) from the camera's frame to the one of the bins: forwards, left, up."""
    up, ahead = np.asarray(image.camera.up), forwards(image.camera)
    return np.stack([ahead, np.cross(up, ahead), up])


def beams_of(image: DepthImage, *, behind_m: float, max_depth: float, max_range: float) -> Beams:
    """The beams of an image's measurements, in bins that suit searches for the nearest of them.

    Those of a moving sensor are seen from the sensor's pose, as wavemap does it once points are undistorted.
    Voxels are updated up to ``behind_m`` metres of range behind a measurement, and no further than
    ``max_depth`` metres of depth and ``max_range`` metres of range.
    """
    depth = image.to_numpy().astype(np.float64)
    points, lengths = points_at(image.camera, depth), np.linalg.norm(image.camera.rays(), axis=-1)
    range_m = np.linalg.norm(points, axis=-1)
    measured = (depth > 0) & (range_m > 0)
    points, lengths, range_m = points[measured], lengths[measured], range_m[measured]
    units = points / range_m[:, None] @ upright_axes(image).T
    reach_m = np.minimum(range_m + behind_m, np.minimum(max_depth * lengths, max_range))

    coarse = Bins.of(COARSE_STEP_RAD)
    farthest = np.zeros(coarse.rows * coarse.columns, np.float32)
    np.maximum.at(farthest, coarse.numbers(units), reach_m.astype(np.float32))
    near_rad = _radius_with_neighbours(units, coarse)

    bins = Bins.of(max(near_rad, LEAST_STEP_RAD))
    numbers = bins.numbers(units)
    order = np.argsort(numbers, kind="stable")
    starts = np.zeros(bins.rows * bins.columns + 1, np.int32)
    np.cumsum(np.bincount(numbers, minlength=len(starts) - 1), out=starts[1:])
    beams = np.zeros((max(1, len(numbers)), 5), np.float32)
    beams[: len(numbers)] = np.column_stack([units, range_m, reach_m])[order]
    return Beams(bins, resident(starts), resident(beams), len(numbers), near_rad, coarse, resident(farthest))


def _radius_with_neighbours(units: NDArray[np.float64], coarse: Bins) -> float:
    """The angle around a direction in which there are a few more than NEIGHBOURS beams, if these are spread
    evenly over the bins that hold any; at most a bin."""
    used = np.unique(coarse.numbers(units))
    middles = (used // coarse.columns + 0.5) * coarse.step - 0.5 * math.pi
    area = float(np.cos(middles).sum()) * coarse.step * 2 * math.pi / coarse.columns
    return min(coarse.step, math.sqrt(1.5 * NEIGHBOURS * area / (math.pi * max(1, len(units)))))


@ti.func
def visit_near(beams: Template, direction: Vec3, angle: F32, visit: Template, state: Template):
    """Call ``visit(state, beams, i)`` for each beam within ``angle`` radians of a direction of length 1, and
    for some that are further off."""
    box = beams.bins.around(direction, angle)
    for row in range(box[0], box[1] + 1):
        for column in range(box[2], box[3] + 1):
            cell = beams.bins.number(row, column)
            for i in range(beams.starts[cell], beams.starts[cell + 1]):
                visit(state, beams, i)
