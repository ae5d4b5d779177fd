"""Solids in closed form, for scenes whose truth is known: where a ray enters them, which voxels they touch.

Plain NumPy, without anything of taichi_mrf, so that what is measured with them is independent of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TINY = 1e-12
_PROJECTIONS = 200
"""Alternating projections between a voxel and a segment or disc."""

_CHUNK = 1 << 18
"""Voxels that are tested at once."""


class Shape(Protocol):
    """A convex solid, or a flat disc, in the world frame."""

    @property
    def bounds_m(self) -> Array:
        """Lowest and highest corner, (2, 3)."""

    @property
    def centre_m(self) -> Array:
        """(3,)."""

    @property
    def frame(self) -> Array:
        """Axes as columns, (3, 3): along z lies the axis of a capsule, the normal of a disc."""

    @property
    def half_m(self) -> Array:
        """Half the size along each column of ``frame``, (3,)."""

    def depth(self, origin_m: Array, rays: Array) -> Array:
        """Parameter at which rays (N, 3) from a point outside enter, (N,), inf where they do not."""

    def distance(self, points_m: Array) -> Array:
        """Distance of points (N, 3) in metres, (N,), 0 inside."""

    def touched_by(self, centres_m: Array, half_m: float) -> NDArray[np.bool_]:
        """Which cubes with these centres (N, 3) and half edges it has a point in, (N,)."""


@dataclass(frozen=True, eq=False)
class Box:
    """A box with centre (3,), half sizes (3,) and axes as columns (3, 3)."""

    centre_m: Array
    half_m: Array
    frame: Array

    @property
    def bounds_m(self) -> Array:
        """Lowest and highest corner, (2, 3)."""
        reach = np.abs(self.frame) @ self.half_m
        return np.stack([self.centre_m - reach, self.centre_m + reach])

    def depth(self, origin_m: Array, rays: Array) -> Array:
        """Where rays pass the last of three pairs of planes, if that is before they leave the first."""
        along = rays @ self.frame
        along = np.where(np.abs(along) < _TINY, _TINY, along)
        start = (origin_m - self.centre_m) @ self.frame
        middle, reach = -start / along, self.half_m / np.abs(along)
        enter, leave = (middle - reach).max(axis=1), (middle + reach).min(axis=1)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)

    def distance(self, points_m: Array) -> Array:
        """Length of what sticks out of the half sizes."""
        outside = np.abs((points_m - self.centre_m) @ self.frame) - self.half_m
        return np.linalg.norm(np.maximum(outside, 0), axis=1)

    def touched_by(self, centres_m: Array, half_m: float) -> NDArray[np.bool_]:
        """Separating axes: the two sets of faces' normals, and the products of their edges."""
        apart = centres_m - self.centre_m
        world = np.eye(3)
        edges = [np.cross(a, b) for a in world for b in self.frame.T]
        touched = np.ones(len(centres_m), bool)
        for axis in [*world, *self.frame.T, *edges]:
            reach = half_m * np.abs(axis).sum() + self.half_m @ np.abs(self.frame.T @ axis)
            touched &= np.abs(apart @ axis) <= reach + _TINY
        return touched


@dataclass(frozen=True, eq=False)
class Capsule:
    """A rod with round ends: all within a radius of the segment from ``start_m`` to ``end_m``, (3,) each."""

    start_m: Array
    end_m: Array
    radius_m: float

    @property
    def bounds_m(self) -> Array:
        """Lowest and highest corner, (2, 3)."""
        ends = np.stack([self.start_m, self.end_m])
        return np.stack([ends.min(axis=0) - self.radius_m, ends.max(axis=0) + self.radius_m])

    @property
    def centre_m(self) -> Array:
        """Middle of the segment, (3,)."""
        return 0.5 * (self.start_m + self.end_m)

    @property
    def frame(self) -> Array:
        """Axes as columns, z along the segment."""
        return frame_along(self.end_m - self.start_m)

    @property
    def half_m(self) -> Array:
        """Half the size along each axis, (3,)."""
        length = float(np.linalg.norm(self.end_m - self.start_m))
        return np.array([self.radius_m, self.radius_m, 0.5 * length + self.radius_m])

    def depth(self, origin_m: Array, rays: Array) -> Array:
        """Where rays enter the cylinder between the ends, or the ball at the end that is nearer."""
        axis, start = self.end_m - self.start_m, origin_m - self.start_m
        axis2, ray2 = axis @ axis, np.einsum("ij,ij->i", rays, rays)
        axis_ray, axis_start, ray_start = rays @ axis, axis @ start, rays @ start
        a = np.maximum(axis2 * ray2 - axis_ray**2, _TINY)
        b = axis2 * ray_start - axis_start * axis_ray
        c = axis2 * (start @ start - self.radius_m**2) - axis_start**2
        root = b * b - a * c
        near = np.flatnonzero(root >= 0)
        t = (-b[near] - np.sqrt(root[near])) / a[near]
        height = axis_start + t * axis_ray[near]
        out = np.full(len(rays), np.inf)
        body = (height > 0) & (height < axis2) & (t > 0)
        out[near[body]] = t[body]
        for end, beyond in ((self.start_m, height <= 0), (self.end_m, height >= axis2)):
            who = near[beyond]
            to = origin_m - end
            half_b = rays[who] @ to
            inside = half_b**2 - ray2[who] * (to @ to - self.radius_m**2)
            t_ball = (-half_b - np.sqrt(np.maximum(inside, 0))) / ray2[who]
            out[who] = np.where((inside >= 0) & (t_ball > 0), t_ball, np.inf)
        return out

    def distance(self, points_m: Array) -> Array:
        """Distance of the segment, less the radius."""
        return np.maximum(np.linalg.norm(points_m - self._nearest(points_m), axis=1) - self.radius_m, 0)

    def touched_by(self, centres_m: Array, half_m: float) -> NDArray[np.bool_]:
        """Whether segment and cube are within a radius."""
        return _gap(self._nearest, centres_m, half_m) <= self.radius_m + 1e-9

    def _nearest(self, points_m: Array) -> Array:
        axis = self.end_m - self.start_m
        share = np.clip((points_m - self.start_m) @ axis / (axis @ axis), 0, 1)
        return self.start_m + share[:, None] * axis


@dataclass(frozen=True, eq=False)
class Disc:
    """A flat disc: centre (3,), normal of length 1 (3,), radius."""

    centre_m: Array
    normal: Array
    radius_m: float

    @property
    def bounds_m(self) -> Array:
        """Lowest and highest corner, (2, 3)."""
        reach = self.radius_m * np.sqrt(np.maximum(1 - self.normal**2, 0))
        return np.stack([self.centre_m - reach, self.centre_m + reach])

    @property
    def frame(self) -> Array:
        """Axes as columns, z along the normal."""
        return frame_along(self.normal)

    @property
    def half_m(self) -> Array:
        """Half the size along each axis, (3,)."""
        return np.array([self.radius_m, self.radius_m, 0.0])

    def depth(self, origin_m: Array, rays: Array) -> Array:
        """Where rays meet the plane, if that is within the radius."""
        slope = rays @ self.normal
        to = self.centre_m - origin_m
        t = (to @ self.normal) / np.where(np.abs(slope) < _TINY, _TINY, slope)
        off = t[:, None] * rays - to
        return np.where((t > 0) & (np.einsum("ij,ij->i", off, off) <= self.radius_m**2), t, np.inf)

    def distance(self, points_m: Array) -> Array:
        """Distance of the nearest point of the disc."""
        return np.linalg.norm(points_m - self._nearest(points_m), axis=1)

    def touched_by(self, centres_m: Array, half_m: float) -> NDArray[np.bool_]:
        """Whether disc and cube have a point in common."""
        return _gap(self._nearest, centres_m, half_m) <= 1e-3 * half_m

    def _nearest(self, points_m: Array) -> Array:
        off = points_m - self.centre_m
        off -= np.outer(off @ self.normal, self.normal)
        length = np.linalg.norm(off, axis=1, keepdims=True)
        return self.centre_m + off * np.minimum(1, self.radius_m / np.maximum(length, _TINY))


def frame_along(direction: Array) -> Array:
    """Axes as columns, (3, 3), right-handed, of which z points along a direction (3,)."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def voxels_of(shape: Shape, voxel_size: float) -> NDArray[np.int64]:
    """The voxels that a shape has a point in, (N, 3): voxel i covers i to i + 1 voxel sizes on each axis."""
    lowest, highest = np.floor(shape.bounds_m / voxel_size + [[-1e-6], [1e-6]]).astype(np.int64)
    rows = np.indices(tuple(highest[1:] - lowest[1:] + 1)).reshape(2, -1).T + lowest[1:]
    many = max(1, _CHUNK // len(rows))
    found = []
    for first in range(lowest[0], highest[0] + 1, many):
        columns = np.arange(first, min(first + many, highest[0] + 1))
        voxels = np.column_stack([np.repeat(columns, len(rows)), np.tile(rows, (len(columns), 1))])
        found.append(voxels[_touched(shape, voxels, voxel_size)])
    return np.concatenate(found)


def _touched(shape: Shape, voxels: NDArray[np.int64], voxel_size: float) -> NDArray[np.bool_]:
    """Which of some voxels (N, 3) a shape has a point in, (N,)."""
    centres_m, half = (voxels.astype(np.float64) + 0.5) * voxel_size, 0.5 * voxel_size
    distance = shape.distance(centres_m)
    touched = distance <= half  # a ball in the voxel touches
    doubtful = np.flatnonzero(~touched & (distance <= half * 3**0.5))
    touched[doubtful] = shape.touched_by(centres_m[doubtful], half)
    return touched


def _gap(nearest: Callable[[Array], Array], centres_m: Array, half_m: float) -> Array:
    """Distance between a convex set and cubes, (N,): each's point nearest to the other's, in turn."""
    points = centres_m
    on_set = nearest(points)
    for _ in range(_PROJECTIONS if len(centres_m) else 0):
        points = np.clip(on_set, centres_m - half_m, centres_m + half_m)
        moved = nearest(points)
        settled = np.abs(moved - on_set).max() < 1e-7 * half_m
        on_set = moved
        if settled:
            break
    return np.linalg.norm(on_set - np.clip(on_set, centres_m - half_m, centres_m + half_m), axis=1)
