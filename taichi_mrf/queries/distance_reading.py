"""Kernels that read a distance field: between the centres of voxels, with the gradient, and for many
balls."""

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.types import (
    F32,
    F64,
    I32,
    AnyArray2,
    DVec3,
    F32Array,
    F32Array2,
    IVec3,
    Template,
    Vec3,
    Vec4,
)
from taichi_mrf.queries.distance_grid import FAR, SAMPLES, SIDE, FieldGrid
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti

NO_DISTANCE = 1e30
"""In place of a distance that is not known: finite, because Taichi's fast maths may not keep NaN apart."""

_ALL_OBSTACLES = 0xFF

_FARTHEST = float(2**20)
"""In voxels from the window: points further away count as this far."""


@dataclass(frozen=True)
class PointsInPlace(Bundle):
    """Points as they were given, (N, 3) float32 or float64 in metres: CPU and CUDA read them where they
    are."""

    points: AnyArray2

    voxel_size: F64

    lowest: DVec3
    """The centre of the window's first voxel, in voxels."""

    @ti.func
    def split(self, i: I32):
        """The voxel of the window whose centre comes before point i along each axis, and how far the point is
        beyond it, in voxels."""
        place = DVec3(self.points[i, 0], self.points[i, 1], self.points[i, 2]) / self.voxel_size - self.lowest
        place = ti.min(ti.max(place, -_FARTHEST), _FARTHEST)
        whole = ti.floor(place)
        return ti.cast(whole, ti.i32), ti.cast(place - whole, ti.f32)


@dataclass(frozen=True)
class PointsMoved(Bundle):
    """Points (N, 3) in voxels from the centre of the window's first voxel: devices that may lack float64."""

    points: F32Array2

    @ti.func
    def split(self, i: I32):
        """As PointsInPlace.split."""
        place = Vec3(self.points[i, 0], self.points[i, 1], self.points[i, 2])
        place = ti.min(ti.max(place, -_FARTHEST), _FARTHEST)
        whole = ti.floor(place)
        return ti.cast(whole, ti.i32), place - whole


FieldPoints: TypeAlias = PointsInPlace | PointsMoved


def field_points(points: Any, voxel_size: float, lowest_voxel: NDArray[np.int64]) -> FieldPoints:
    """Points (N, 3) in metres as kernels take them; ``lowest_voxel`` (3,) is the window's first."""
    lowest = lowest_voxel + 0.5
    if runtime.active() == "vulkan":
        return PointsMoved((np.asarray(points, np.float64) / voxel_size - lowest).astype(np.float32))
    return PointsInPlace(points, voxel_size, ti.Vector(lowest.tolist(), ti.f64))


@dataclass(frozen=True)
class FieldValues(Bundle):
    """The distances of a field, as points read them."""

    grid: FieldGrid

    values: F32Array
    """(slots * 729) metres."""

    far_m: F32
    """The distance in FAR bricks."""

    outside_m: F32
    """The distance in OUTSIDE bricks."""

    lower: Vec3
    """The field ends here, in voxels from the centre of the window's first."""

    upper: Vec3

    per_voxel: F32
    """Voxels in a metre."""

    @ti.func
    def at(self, whole: IVec3, share: Vec3):
        """The distance and its gradient, ``share`` beyond the centre of the voxel ``whole``."""
        slot = self.grid.slot(whole >> 3)
        found = Vec4(self.outside_m, 0.0, 0.0, 0.0)
        place = ti.cast(whole, ti.f32) + share
        if slot >= 0:
            inner = whole & 7
            i = slot * SAMPLES + (inner[0] * SIDE + inner[1]) * SIDE + inner[2]
            found = self.between(i, share)
        elif slot == FAR:
            found[0] = self.far_m
        unknown = (place - self.lower).min() < 0.0 or (self.upper - place).min() < 0.0
        if self.grid.outside_class > _ALL_OBSTACLES:
            nearest = whole + ti.cast(share + 0.5, ti.i32)
            unknown = unknown or self.grid.is_unknown(nearest) == 1
        if unknown:
            found = Vec4(NO_DISTANCE, 0.0, 0.0, 0.0)
        return found

    @ti.func
    def between(self, i: I32, share: Vec3):
        """Trilinear between the eight values from place i on, and the exact gradient of that."""
        x, y, z = share[0], share[1], share[2]
        a000, a001 = self.values[i], self.values[i + 1]
        a010, a011 = self.values[i + SIDE], self.values[i + SIDE + 1]
        a100, a101 = self.values[i + SIDE * SIDE], self.values[i + SIDE * SIDE + 1]
        a110, a111 = self.values[i + SIDE * SIDE + SIDE], self.values[i + SIDE * SIDE + SIDE + 1]
        a00, a01 = a000 + z * (a001 - a000), a010 + z * (a011 - a010)
        a10, a11 = a100 + z * (a101 - a100), a110 + z * (a111 - a110)
        a0, a1 = a00 + y * (a01 - a00), a10 + y * (a11 - a10)
        along_y = (1.0 - x) * (a01 - a00) + x * (a11 - a10)
        at_0 = (1.0 - y) * (a001 - a000) + y * (a011 - a010)
        at_1 = (1.0 - y) * (a101 - a100) + y * (a111 - a110)
        gradient = Vec3(a1 - a0, along_y, (1.0 - x) * at_0 + x * at_1) * self.per_voxel
        return Vec4(a0 + x * (a1 - a0), gradient[0], gradient[1], gradient[2])


@kernel
def read_distances(points: Template, field: FieldValues, out: F32Array) -> None:
    """Distances of points (FieldPoints), into ``out`` (N) in metres; NO_DISTANCE where there is none."""
    for i in range(out.shape[0]):
        whole, share = points.split(i)
        out[i] = field.at(whole, share)[0]


@kernel
def read_gradients(points: Template, field: FieldValues, out: F32Array, gradient: F32Array2) -> None:
    """Distances as in :func:`read_distances`, and ``gradient`` (N, 3), 0 where there is no distance."""
    for i in range(out.shape[0]):
        whole, share = points.split(i)
        found = field.at(whole, share)
        out[i] = found[0]
        for axis in ti.static(range(3)):
            gradient[i, axis] = found[1 + axis]


@kernel
def read_clearances(points: Template, field: FieldValues, radii: F32Array, out: F32Array) -> None:
    """The least of distance less radius over the balls of each body, into ``out`` (C); NO_DISTANCE if one of
    them has no distance. ``points`` (FieldPoints) are the centres of body 0, then of body 1, ..., ``radii``
    (S)."""
    for body in range(out.shape[0]):
        least, most = NO_DISTANCE, -NO_DISTANCE
        for ball in range(radii.shape[0]):
            whole, share = points.split(body * radii.shape[0] + ball)
            distance = field.at(whole, share)[0]
            least = ti.min(least, distance - radii[ball])
            most = ti.max(most, distance)
        if most > 0.5 * NO_DISTANCE:
            least = NO_DISTANCE
        out[body] = least
