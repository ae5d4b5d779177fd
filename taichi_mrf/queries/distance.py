"""Distances to the nearest obstacle, with their gradients, for planners.

The distances are exact at the centres of voxels and linear between them along each axis, so that the
gradient is exactly that of the returned distance. They are clamped at a given distance, which bounds the
effect of a change in the map.
"""

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import real
from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import voxels_of_box
from taichi_mrf.queries.distance_bricks import DistanceBricks
from taichi_mrf.queries.distance_grid import FAR, SAMPLES, SIDE, FieldGrid, SpaceRules, UnknownSpace
from taichi_mrf.queries.free import bound_now
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.owner import Owned
from taichi_mrf.system.types import (
    F32,
    F64,
    I32,
    AnyArray2,
    DVec3,
    F32Array,
    F32Array2,
    I32Array2,
    IVec3,
    Template,
    Vec3,
    Vec4,
)
from taichi_mrf.voxels.layout import BRICK

_EDGE = 1e-3
"""In voxels: so far outside of its box a field answers, as rounding goes."""

_ENDLESS = 1e9
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
    """The window's first voxel."""

    @ti.func
    def split(self, i: I32):
        """The voxel of the window whose centre comes before point i along each axis, and how far the point is
        beyond it, in voxels. That follows from the point alone, wherever the window begins."""
        place = DVec3(self.points[i, 0], self.points[i, 1], self.points[i, 2]) / self.voxel_size - 0.5
        whole = ti.floor(place)
        voxel = ti.min(ti.max(whole - self.lowest, -_FARTHEST), _FARTHEST)
        return ti.cast(voxel, ti.i32), ti.cast(place - whole, ti.f32)


@dataclass(frozen=True)
class PointsMoved(Bundle):
    """Results of PointsInPlace.split for each point, (N, 3) each, for devices that may lack float64."""

    voxels: I32Array2
    shares: F32Array2

    @ti.func
    def split(self, i: I32):
        """As PointsInPlace.split."""
        voxel = IVec3(self.voxels[i, 0], self.voxels[i, 1], self.voxels[i, 2])
        return voxel, Vec3(self.shares[i, 0], self.shares[i, 1], self.shares[i, 2])


FieldPoints: TypeAlias = PointsInPlace | PointsMoved


def field_points(points: Any, voxel_size: float, lowest_voxel: NDArray[np.int64]) -> FieldPoints:
    """Points (N, 3) in metres as kernels take them; ``lowest_voxel`` (3,) is the window's first."""
    if runtime.active() == "vulkan":
        place = np.asarray(points, np.float64) / voxel_size - 0.5
        whole = np.floor(place)
        voxels = np.clip(whole - lowest_voxel, -_FARTHEST, _FARTHEST).astype(np.int32)
        return PointsMoved(voxels, (place - whole).astype(np.float32))
    return PointsInPlace(points, voxel_size, ti.Vector(lowest_voxel.tolist(), ti.f64))


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


class DistanceField(Owned):
    """Signed distances in metres to the nearest obstacle, anywhere in a map.

    A voxel's distance is that of its centre to the centre of the nearest obstacle, less half a voxel, so that
    it is 0 on the faces of obstacles. In obstacles it is negative: half a voxel less the distance to the
    centre of the nearest voxel that is not one. Distances are clamped at +-``max_distance_m``.

    The field is that of the map at the last :meth:`update`. On the map's device it takes :attr:`bytes`, about
    14 for each voxel within ``max_distance_m`` of an obstacle.
    """

    def __init__(
        self,
        m: VoxelMap,
        max_distance_m: float,
        unknown: UnknownSpace = "free",
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        level: float | None = None,
    ) -> None:
        """Compute the distances of a map as it is now.

        ``unknown`` is the treatment of unknown voxels: "free" space; "occupied", that is, obstacles; or
        "unknown": no obstacles, but the distance in them is NaN. ``lower`` and ``upper``, (3,) in metres,
        limit the field to a box, outside which all is NaN; obstacles around it count. With a ``level``, free
        voxels that are not free at that level (``m.free_with``) are obstacles, so that distances are lower
        bounds; with ``unknown="occupied"``, everything that is not free at the level is.

        Raises ConfigError for another rule, a distance that is not positive or more than 1024 voxels, corners
        that make no box, and a level that the map cannot promise (then also :meth:`update`); CapacityError if
        there is not enough memory.
        """
        if unknown not in ("free", "occupied", "unknown"):
            raise ConfigError(f"unknown must be free, occupied or unknown, not {unknown!r}")
        if (lower is None) != (upper is None):
            raise ConfigError("a distance field needs both corners of its box, lower and upper, or none")
        self.map, self.unknown, self.level = m, unknown, level
        self.max_distance_m = real(max_distance_m, "max_distance_m", above=0)
        rules = SpaceRules.of(unknown, self.max_distance_m, m.voxel_size)
        self._bricks = DistanceBricks(rules)
        self._within = self._box_m = None
        self._complete = False
        if lower is not None and upper is not None:
            first, after = voxels_of_box(lower, upper, m.voxel_size)
            margin = rules.reach + 1
            self._within = (first - margin) // BRICK, (after + margin) // BRICK
            self._box_m = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        self.update()

    @property
    def bytes(self) -> int:
        """Memory of the field in bytes."""
        return self._bricks.bytes

    def update(self, m: VoxelMap | None = None) -> int:
        """Update the distances that changes of the map since the last call affect; returns the number of
        updated voxels. ``m`` is another map to follow from now on, such as a later layer or reading, with
        voxels of the same size.

        Raises ConfigError for voxels of another size, CapacityError if there is not enough memory; after
        that, queries fail until an update succeeds.
        """
        if m is not None:
            if not np.isclose(m.voxel_size, self.map.voxel_size, rtol=1e-6):
                raise ConfigError(
                    f"a distance field with voxels of {self.map.voxel_size:g} m cannot follow a map with "
                    f"voxels of {m.voxel_size:g} m"
                )
            self.map = m
        if not self._complete:
            self._bricks.start_over()
        self._complete = False
        most = None if self.level is None else bound_now(self.map, self.level)
        voxels = self._bricks.update(self.map, self._within, most)
        self._complete = True
        return voxels

    @tensors.in_kind("points", on_device=True)
    def distance(self, points: ArrayLike) -> NDArray[np.float32]:
        """Metres to the nearest obstacle at points (N, 3) in metres, (N,) float32; NaN where unknown.
        Raises ConfigError for points of another shape or that are not finite."""
        given = tensors.real_array(points, "points", ("N", 3))
        out = tensors.empty(given, given.shape[:1])
        if len(given):
            read_distances(self._points(given), self._values(), out)
            runtime.settle()
        return self._told(out)

    @tensors.in_kind("points", on_device=True)
    def distance_and_gradient(self, points: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Distances of points as in :meth:`distance`, and their gradients: the change per metre along x, y
        and z, (N, 3) float32. A gradient points away from the nearest obstacle, with a length of nearly 1,
        and is 0 where the distance is clamped. Raises ConfigError."""
        given = tensors.real_array(points, "points", ("N", 3))
        out, gradient = tensors.empty(given, given.shape[:1]), tensors.empty(given, given.shape)
        if len(given):
            read_gradients(self._points(given), self._values(), out, gradient)
            runtime.settle()
        if self._may_lack:
            gradient[out > 0.5 * NO_DISTANCE] = np.nan
        return self._told(out), gradient

    @tensors.in_kind("centres", "radii_m", on_device=True)
    def clearance(self, centres: ArrayLike, radii_m: ArrayLike) -> NDArray[np.float32]:
        """Clearance of bodies made of balls: centres (C, S, 3) of S balls for each of C bodies or
        configurations, in metres, and their radii (S,) -> (C,) float32, the smallest distance of a centre
        minus its radius. It is positive if no ball touches an obstacle, and NaN if the distance of any ball
        is unknown.

        Raises ConfigError for arrays that do not fit or are not finite, and for radii that are negative or
        not less than ``max_distance_m``.
        """
        given = tensors.real_array(centres, "centres", ("C", "S", 3))
        radii = np.ascontiguousarray(tensors.on_host(radii_m, "radii_m"), np.float32)
        if radii.shape != given.shape[1:2] or not len(radii):
            raise ConfigError(
                f"centres (C, S, 3) need radii_m (S,), one or more, not {given.shape} and {radii.shape}"
            )
        if not (radii.min() >= 0 and radii.max() < self.max_distance_m):
            raise ConfigError(
                f"radii_m must be at least 0 and less than max_distance_m, {self.max_distance_m:g} m"
            )
        out = tensors.empty(given, given.shape[:1])
        if len(given):
            read_clearances(self._points(given.reshape(-1, 3)), self._values(), radii, out)
            runtime.settle()
        return self._told(out)

    @property
    def _may_lack(self) -> bool:
        return self.unknown == "unknown" or self._box_m is not None

    def _told(self, out: Any) -> Any:
        if self._may_lack:
            out[out > 0.5 * NO_DISTANCE] = np.nan
        return out

    def _points(self, points: Any) -> FieldPoints:
        return field_points(points, self.map.voxel_size, self._bricks.lowest * BRICK)

    def _values(self) -> FieldValues:
        if not self._complete:
            raise ConfigError("the last update of this distance field did not end: call update() again")
        bricks, voxel_size = self._bricks, self.map.voxel_size
        lower, upper = np.full(3, -_ENDLESS), np.full(3, _ENDLESS)
        if self._box_m is not None:
            centre = bricks.lowest * BRICK + 0.5
            lower, upper = (corner / voxel_size - centre for corner in self._box_m)
        return FieldValues(
            bricks.grid, bricks.values, self.max_distance_m, bricks.rules.outside_m,
            ti.Vector((lower - _EDGE).tolist(), ti.f32), ti.Vector((upper + _EDGE).tolist(), ti.f32),
            1 / voxel_size,
        )  # fmt: skip
