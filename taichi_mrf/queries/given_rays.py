"""Rays as they were given, (N, 3) float32 or float64 in metres, or one origin or direction for all of them,
and the space that they go through, for queries in which unknown space stops a ray or counts.

The index of a window (voxels/window.py) names the bricks that exist. Here it also names, by the slot behind
the pool's last, every brick that no ray has crossed, so that a ray meets its voxels as it meets others; what
was seen to be free and has no voxels stays out of the index and is skipped.

CPU and CUDA read rays where they are, as they do points (distance.py): what float32 cannot hold of a place
far from the origin is subtracted in float64 on the way. Vulkan may lack float64, so the host does it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.known_bricks import seen_free_bricks
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F64, I32, AnyArray2, DVec3, F32Array, F32Array2, F64Array, Vec3
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.window import Window


class RaySpace:
    """A map's known and unknown space. It is good for as long as the map does not change."""

    def __init__(self, m: VoxelMap) -> None:
        self.map, self._pool = m, m.view.pool
        self._slots = self._pool.in_use
        self._bricks, self._free = self._pool.bricks[self._slots], seen_free_bricks(m)

    @property
    def unknown_from(self) -> int:
        """Voxels of the index from this number on are those of bricks that no ray has crossed."""
        return self._pool.capacity * VOXELS

    def known_box_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Two corners, in metres, around all bricks that are known, and a layer of unknown ones; None if the
        map is empty."""
        known = np.concatenate([self._bricks, self._free])
        if not len(known):
            return None
        brick_m = self.map.voxel_size * BRICK
        return (known.min(axis=0) - 1) * brick_m, (known.max(axis=0) + 2) * brick_m

    @contextmanager
    def indexed(self, lower_m: NDArray[np.float64], upper_m: NDArray[np.float64]) -> Iterator[Window]:
        """A window around a box in metres, which stands in ``map.view.index`` while the block runs.

        Raises CapacityError if the box has too many bricks.
        """
        window = Window.covering(lower_m, upper_m, self.map.voxel_size)
        slots = np.full(window.cells, self._pool.capacity, np.int32)
        free, kept = window.cells_of(self._free), window.cells_of(self._bricks)
        slots[free[free >= 0]] = -1
        slots[kept[kept >= 0]] = self._slots[kept >= 0]
        cells = np.flatnonzero(slots >= 0).astype(np.int32)
        index = self.map.view.index
        index.fill(window, cells, slots[cells])
        try:
            yield window
        finally:
            index.clear(window, cells)
            runtime.settle()


_STRIP = 64
"""Rays that one thread bounds."""


@dataclass(frozen=True)
class RaysInPlace(Bundle):
    """Rays as they were given: ray i has the origin ``i * origin_step`` and the direction
    ``i * direction_step``, steps of 0 or 1."""

    origins: AnyArray2

    origin_step: I32

    directions: AnyArray2

    direction_step: I32

    voxel_size: F64

    lowest: DVec3
    """The window's corner, in voxels."""

    @ti.func
    def origin(self, i: I32):
        """Origin of ray i, in metres."""
        k = i * self.origin_step
        return DVec3(self.origins[k, 0], self.origins[k, 1], self.origins[k, 2])

    @ti.func
    def direction(self, i: I32):
        """The way of ray i, as long as it was given."""
        k = i * self.direction_step
        return DVec3(self.directions[k, 0], self.directions[k, 1], self.directions[k, 2])

    @ti.func
    def unit(self, i: I32):
        """The way of ray i for one metre."""
        way = self.direction(i)
        return way / ti.sqrt(way.dot(way))

    @ti.func
    def start(self, i: I32):
        """Origin of ray i, in voxels from the window's corner."""
        return ti.cast(self.origin(i) / self.voxel_size - self.lowest, ti.f32)

    @ti.func
    def way(self, i: I32):
        """The way of ray i in voxels for one metre."""
        return ti.cast(self.unit(i) / self.voxel_size, ti.f32)


@dataclass(frozen=True)
class RaysMoved(Bundle):
    """Rays (N, 3) in voxels from the window's corner, and in voxels for one metre."""

    origins: F32Array2

    directions: F32Array2

    @ti.func
    def start(self, i: I32):
        """As RaysInPlace.start."""
        return Vec3(self.origins[i, 0], self.origins[i, 1], self.origins[i, 2])

    @ti.func
    def way(self, i: I32):
        """As RaysInPlace.way."""
        return Vec3(self.directions[i, 0], self.directions[i, 1], self.directions[i, 2])


WindowRays: TypeAlias = RaysInPlace | RaysMoved


class GivenRays:
    """Rays as a query gets them; there are ``count``. ``like`` is an array in whose memory answers go."""

    def __init__(self, origins: ArrayLike, directions: ArrayLike) -> None:
        """Raises ConfigError for arrays that do not fit or are not finite."""
        start, along = tensors.numbers(origins, "origins"), tensors.numbers(directions, "directions")
        shapes = tuple(start.shape), tuple(along.shape)
        counts = {shape[0] for shape in shapes if len(shape) == 2}
        if not all(len(s) in (1, 2) and s[-1] == 3 for s in shapes) or len(counts) != 1:
            raise ConfigError(
                f"rays need origins and directions of shape (N, 3), not {shapes[0]} and {shapes[1]}"
            )
        tensors.check_finite(start, "rays")
        tensors.check_finite(along, "rays")
        (self.count,) = counts
        self._steps = tuple(len(shape) - 1 for shape in shapes)
        self.like, self._start, self._along = _together(start.reshape(-1, 3), along.reshape(-1, 3))

    def corners(self, max_range: float) -> NDArray[np.float64]:
        """Two corners (2, 3), in metres, of the box around all rays. Raises ConfigError for a direction of no
        length."""
        if runtime.active() == "vulkan":
            ends = self._start + self._unit() * max_range
            low, high = np.minimum(self._start, ends), np.maximum(self._start, ends)
            return np.stack([low.min(axis=0), high.max(axis=0)])
        strips = -(-self.count // _STRIP)
        least, most = (tensors.empty(self.like, (strips, 3), "float64") for _ in range(2))
        lengths = tensors.empty(self.like, (strips,), "float64")
        _bound(self._in_place(1.0, np.zeros(3)), self.count, max_range, least, most, lengths)
        if float(lengths.min()) == 0:
            raise ConfigError("a ray has a direction of no length")
        return np.stack([tensors.as_numpy(least).min(axis=0), tensors.as_numpy(most).max(axis=0)])

    def within(self, window: Window) -> WindowRays:
        """The rays as kernels follow them through a window."""
        if runtime.active() == "vulkan":
            start = np.broadcast_to(window.to_voxels(self._start), (self.count, 3))
            way = np.broadcast_to(self._unit() / window.voxel_size, (self.count, 3))
            return RaysMoved(np.ascontiguousarray(start, np.float32), np.ascontiguousarray(way, np.float32))
        return self._in_place(window.voxel_size, np.asarray(window.lowest, np.float64) * BRICK)

    def points(self, range_m: Any) -> Any:
        """The points (N, 3) at ranges (N,) in metres."""
        if runtime.active() == "vulkan":
            return self._start + self._unit() * range_m[:, None].astype(np.float64)
        points = tensors.empty(self.like, (self.count, 3), "float64")
        if self.count:
            _follow(self._in_place(1.0, np.zeros(3)), range_m, points)
        return points

    def _in_place(self, voxel_size: float, lowest: NDArray[np.float64]) -> RaysInPlace:
        origin_step, direction_step = self._steps
        return RaysInPlace(
            self._start, origin_step, self._along, direction_step, voxel_size,
            ti.Vector(lowest.tolist(), ti.f64),
        )  # fmt: skip

    def _unit(self) -> NDArray[np.float64]:
        length = np.linalg.norm(self._along.astype(np.float64), axis=1, keepdims=True)
        if (length == 0).any():
            raise ConfigError("a ray has a direction of no length")
        return np.asarray(self._along / length, np.float64)


def _together(start: Any, along: Any) -> tuple[Any, Any, Any]:
    """Both in one memory: that of a device if one of them is there. The first is whose memory it is."""
    if isinstance(start, np.ndarray) == isinstance(along, np.ndarray):
        return start, start, along
    like = along if isinstance(start, np.ndarray) else start
    return like, tensors.moved_to(like, start), tensors.moved_to(like, along)


@kernel
def _bound(
    rays: RaysInPlace, count: I32, max_range: F64, least: AnyArray2, most: AnyArray2, lengths: F64Array
) -> None:
    """The box around each strip of rays, which end at ``max_range`` metres, into ``least`` and ``most``
    (strips, 3), and the square of its shortest direction into ``lengths`` (strips)."""
    for strip in range(lengths.shape[0]):
        first = strip * _STRIP
        low = rays.origin(first)
        high = rays.origin(first)
        shortest = rays.direction(first).dot(rays.direction(first))
        for i in range(first, ti.min(first + _STRIP, count)):
            begin = rays.origin(i)
            end = begin + rays.unit(i) * max_range
            low = ti.min(low, begin, end)
            high = ti.max(high, begin, end)
            shortest = ti.min(shortest, rays.direction(i).dot(rays.direction(i)))
        lengths[strip] = shortest
        for axis in ti.static(range(3)):
            least[strip, axis] = low[axis]
            most[strip, axis] = high[axis]


@kernel
def _follow(rays: RaysInPlace, range_m: F32Array, points: AnyArray2) -> None:
    """The points at ``range_m`` (N) metres along rays, into ``points`` (N, 3)."""
    for i in range(range_m.shape[0]):
        point = rays.origin(i) + rays.unit(i) * range_m[i]
        for axis in ti.static(range(3)):
            points[i, axis] = point[axis]
