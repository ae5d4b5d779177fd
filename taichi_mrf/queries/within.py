"""Probability that something lies in a ball, or in the way of a ball that moves: voxels taken together.

A ray has one first surface. Where its depth is uncertain the voxels along the ray share it, so along a line
the chances of voxels with evidence of a surface add up; voxels without it are independent. Lines side by side
mostly see the same surface, with the same error, so theirs do not add up. The probability that something lies
in a ball is that of its likeliest line,

    P(ball) = min over axes of  max over lines along the axis of
                  1 - max(0, 1 - sum_{i in S} m_i l_i)  prod_{i not in S} (1 - m_i l_i),

where m_i is the marginal of voxel i, l_i the length of the line in the voxel and in the ball, in voxels, and
S are the voxels likelier than the prior. Of the three axes, the one along which the surface is uncertain
gives the least: the others run along the surface and count it again in each voxel. A ball that moves hits
something with the probability of its likeliest place. docs/decisions.md compares these rules with others.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array, real
from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.points import checked_points
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.types import F32, I32, F32Array, F32Array2, I32Array, IVec3, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.log_odds import logistic
from taichi_mrf.voxels.numbering import flat, voxel_number
from taichi_mrf.voxels.pool import BrickPool

_UNKNOWN, _SEEN_FREE = -1, -2
"""In place of a slot: bricks without voxels."""

_BYTES_PER_BRICK = 24
"""Coordinates, slots and crossings of a brick of the box around a query."""

_MARGIN = 0.01
"""In bricks: so much wider than its balls is the box, so that rounding leads no line out of it."""

_PLACES_APART = 0.5
"""In radii: the tube of balls so far apart is nowhere thinner than 0.97 of their radius."""

_FARTHEST = 2**14
"""Bricks along an edge of the box, up to which float32 places a line to within the margin."""


@dataclass(frozen=True)
class _Voxels(Bundle):
    """The voxels of a box of bricks, as lines read them."""

    shape: IVec3
    """Of the box, in bricks."""

    slots: I32Array
    """(bricks): the slot in the pool, _UNKNOWN or _SEEN_FREE."""

    belief: F32Array
    """(pool * 512) log-odds."""

    prior: F32
    """Log-odds of a voxel of which nothing is known."""

    unknown: F32
    """Marginal of voxels in bricks that no ray has crossed."""

    free: F32
    """Marginal of voxels in bricks that rays have crossed, and that have no voxels."""


class BrickIndex(Protocol):
    """Index of bricks and of the rays that have crossed them; part of a Topology."""

    def slots(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]: ...

    def crossings(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]: ...


def occupied_within(
    points: ArrayLike,
    radius_m: float,
    voxel_size: float,
    topology: BrickIndex,
    pool: BrickPool,
    seen_free: float,
) -> NDArray[np.float32]:
    """The probability that something lies within ``radius_m`` of points (N, 3), in metres: (N,) float32.

    ``seen_free`` are the log-odds of voxels without a brick that rays have crossed. Raises ConfigError for
    points of another shape or not finite and for a radius that is not positive, CapacityError if the box
    around the points has too many bricks.
    """
    points_m = checked_points(points)
    radius = real(radius_m, "radius_m", above=0) / voxel_size
    if len(points_m) == 0:
        return np.zeros(0, np.float32)
    centres = points_m / voxel_size
    lowest = np.floor((centres.min(axis=0) - radius) / BRICK - _MARGIN)
    shape = np.floor((centres.max(axis=0) + radius) / BRICK + _MARGIN) - lowest + 1
    bricks = float(np.prod(shape))
    if max(shape.max(), np.abs(lowest).max()) > _FARTHEST or bricks >= 2**31:
        raise ConfigError("points lie too far apart, or too far from the origin, for one query")
    check_memory(_BYTES_PER_BRICK * bricks, f"a query in a box of {bricks:.3g} bricks of {BRICK}^3 voxels")
    inside = np.indices(tuple(shape.astype(int))).reshape(3, -1).T + lowest
    cells = np.ascontiguousarray(inside, np.int32)
    slots = topology.slots(cells)
    slots[(slots < 0) & (topology.crossings(cells) > 0)] = _SEEN_FREE
    prior = float(pool.prior_log_odds)
    unknown, free = (float(1.0 / (1.0 + np.exp(-x))) for x in (prior, seen_free))
    out = np.zeros(len(points_m), np.float32)
    box = ti.Vector(shape.astype(int).tolist(), ti.i32)
    voxels = _Voxels(box, slots, pool.belief, prior, unknown, free)
    _look_around((centres - lowest * BRICK).astype(np.float32), radius, voxels, out)
    runtime.settle()
    return out


def path_collision(
    points: ArrayLike,
    radius_m: float,
    voxel_size: float,
    topology: BrickIndex,
    pool: BrickPool,
    seen_free: float,
) -> NDArray[np.float32]:
    """The probability that a ball of ``radius_m`` metres hits something on its way along straight lines from
    point to point: a path (N, 3) in metres -> (), paths (P, N, 3) -> (P,), float32.

    The rest as in :func:`occupied_within`; also raises ConfigError for a path without points.
    """
    paths, whole = checked_paths(points)
    step = _PLACES_APART * real(radius_m, "radius_m", above=0)
    places, path_of = path_places(paths, step)
    there = occupied_within(places, radius_m, voxel_size, topology, pool, seen_free)
    likeliest = np.zeros(len(paths), np.float32)
    np.maximum.at(likeliest, path_of, there)
    return likeliest.reshape(whole)


def checked_paths(points: ArrayLike) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """A path (N, 3) or paths (P, N, 3) as paths, and the shape of an answer for each of them. Raises
    ConfigError for another shape, a path without points and a point that is not finite."""
    given = array(points, "points")
    if given.ndim not in (2, 3) or given.shape[-1] != 3 or given.shape[-2] == 0:
        raise ConfigError(f"a path needs points of shape (N, 3) or (P, N, 3), not {given.shape}")
    return checked_points(given.reshape(-1, 3)).reshape(-1, *given.shape[-2:]), given.shape[:-2]


def path_places(paths: NDArray[np.float64], step: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (M, 3) at most ``step`` metres apart along paths (P, N, 3), and the path of each, (M,)."""
    starts, ways = paths[:, :-1].reshape(-1, 3), np.diff(paths, axis=1).reshape(-1, 3)
    parts = np.maximum(np.ceil(np.linalg.norm(ways, axis=1) / step), 1).astype(np.int64)
    way = np.repeat(np.arange(len(ways)), parts)
    along = (np.arange(len(way)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[way]
    between = starts[way] + along[:, None] * ways[way]
    path_of = way // max(1, paths.shape[1] - 1)
    return np.concatenate([between, paths[:, -1]]), np.concatenate([path_of, np.arange(len(paths))])


@kernel
def _look_around(centres: F32Array2, radius: F32, voxels: _Voxels, out: F32Array) -> None:
    """The probability that something lies in each ball. ``centres`` (N, 3) in voxels from the corner of the
    box of ``voxels``, ``radius`` in voxels, ``out`` (N)."""
    for i in range(out.shape[0]):
        centre = Vec3(centres[i, 0], centres[i, 1], centres[i, 2])
        least = 1.0
        for axis in ti.static(range(3)):
            free = 1.0
            beside = ti.floor(radius, ti.i32)
            for a in range(-beside, beside + 1):
                for b in range(-beside, beside + 1):
                    squared = radius * radius - ti.cast(a * a + b * b, ti.f32)
                    # A line with a higher probability than another axis gave can change nothing.
                    if squared > 0.0 and 1.0 - free < least:
                        free = ti.min(free, _free_along(axis, centre, a, b, ti.sqrt(squared), voxels))
            least = ti.min(least, 1.0 - free)
        out[i] = least


@ti.func
def _free_along(axis: Template, centre: Vec3, a: I32, b: I32, half: F32, voxels: Template) -> F32:
    """The probability that a line meets nothing: along an axis through a point ``a`` and ``b`` voxels beside
    the centre, for ``half`` voxels to either side."""
    first = ti.static((axis + 1) % 3)
    second = ti.static((axis + 2) % 3)
    cell = IVec3(0)
    cell[first] = ti.floor(centre[first] + ti.cast(a, ti.f32), ti.i32)
    cell[second] = ti.floor(centre[second] + ti.cast(b, ti.f32), ti.i32)
    t, end = centre[axis] - half, centre[axis] + half
    free = 1.0  # of the voxels that are no likelier than the prior
    surface = 0.0  # in one of the others
    while t < end:
        cell[axis] = ti.floor(t, ti.i32)
        brick = cell // BRICK
        slot = voxels.slots[flat(brick, voxels.shape)]
        leave = ti.min(end, ti.cast((cell[axis] // BRICK + 1) * BRICK, ti.f32))
        if slot >= 0:
            local = cell - brick * BRICK
            index = slot * VOXELS + voxel_number(local)
            stride = ti.static(BRICK ** (2 - axis))
            while t < leave:
                upper = ti.min(leave, ti.floor(t) + 1.0)
                log_odds = voxels.belief[index]
                here = (upper - t) * logistic(log_odds)
                if log_odds > voxels.prior:
                    surface += here
                else:
                    free *= 1.0 - here
                index += stride
                t = upper
        else:
            everywhere = voxels.unknown if slot == _UNKNOWN else voxels.free
            whole = ti.floor(leave) - ti.ceil(t)
            if whole < 0.0:
                free *= 1.0 - everywhere * (leave - t)
            else:
                free *= 1.0 - everywhere * (ti.ceil(t) - t)
                free *= ti.pow(1.0 - everywhere, whole) * (1.0 - everywhere * (leave - ti.floor(leave)))
            t = leave
    return free * ti.max(0.0, 1.0 - surface)
