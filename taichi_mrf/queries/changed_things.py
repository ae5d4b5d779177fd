"""Things that appeared or left between two maps, told apart from surfaces that have shifted a little.

Poses, noise and edges shift a surface by some centimetres from view to view. What is occupied beside a
surface that was there before can be that surface; what stands out of it is something else: a cluster of
voxels that were free and are occupied, or the reverse.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.change import MapChange
from taichi_mrf.queries.frontiers import find_clusters
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys, rows_around
from taichi_mrf.voxels.pool import BrickPool

SLACK_M = 0.15
"""A surface may be so far from where it was, centre to centre, in metres."""

SLACK_VOXELS = 3
"""The slack in voxels, for voxels that are larger than a third of SLACK_M."""

CELL_VOXELS = 2
"""Voxels in touching cells of so many voxels a side are one cluster, so that the parts of a thing count
together."""

CORE_VOXELS = 16
"""A cluster is told of if so many of its voxels are further than the slack from all surfaces."""

PARTS_M = 0.1
"""Parts of one thing may be so far apart, in metres."""

_BRICKS_AT_ONCE = 4096
_STEPS_AT_ONCE = 16


@cache
def _ball(radius: float) -> NDArray[np.int32]:
    """The steps (n, 3) within a radius, in voxels, the shortest first."""
    reach = int(radius)
    steps = np.indices((2 * reach + 1,) * 3).reshape(3, -1).T.astype(np.int32) - reach
    squares = (steps**2).sum(axis=1)
    order = np.argsort(squares, kind="stable")
    return steps[order[: np.count_nonzero(squares <= radius**2)]]


class Surfaces:
    """The occupied voxels of a pool, of ``voxel_size`` metres, by its beliefs or by another ``channel``. Good
    for as long as no brick comes or goes."""

    def __init__(self, pool: BrickPool, voxel_size: float, channel: str = "belief") -> None:
        self._pool, self._channel = pool, channel
        slack = max(SLACK_VOXELS, SLACK_M / voxel_size)
        self._steps = _ball(slack)
        self._reach = math.ceil(slack / BRICK)
        slots = pool.in_use
        keys = grid_keys(pool.bricks[slots])
        order = np.argsort(keys)
        self._keys, self._slots = keys[order], np.append(slots[order], np.int32(-1))

    def _around(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]:
        """The slots of bricks (n, 3) and of those around each, (n, k); -1 where there is none."""
        return self._slots[rows_around(bricks, self._keys, self._reach)]

    def clear(self, voxels: NDArray[np.int32]) -> NDArray[np.bool_]:
        """True for the voxels, coordinates (n, 3), that have no surface within the slack, (n,)."""
        bricks, owner = np.unique(voxels // BRICK, axis=0, return_inverse=True)
        clear = np.ones(len(voxels), np.bool_)
        order = np.argsort(owner.reshape(-1), kind="stable")
        ends = np.searchsorted(owner.reshape(-1)[order], np.arange(len(bricks) + 1))
        for begin in range(0, len(bricks), _BRICKS_AT_ONCE):
            end = min(begin + _BRICKS_AT_ONCE, len(bricks))
            rows = order[ends[begin] : ends[end]]
            clear[rows] = self._clear(voxels[rows], bricks[begin:end], owner.reshape(-1)[rows] - begin)
        return clear

    def _clear(
        self, voxels: NDArray[np.int32], bricks: NDArray[np.int32], owner: NDArray[np.intp]
    ) -> NDArray[np.bool_]:
        """:meth:`clear` for voxels of some bricks (k, 3), each by its ``owner`` among them (n,)."""
        slots, place = np.unique(self._around(bricks), return_inverse=True)
        place = place.reshape(len(bricks), -1)
        occupied = np.zeros((len(slots), VOXELS), np.bool_)
        occupied[slots >= 0] = self._pool.read(self._channel, slots[slots >= 0]) >= 0
        inside, left = voxels - bricks[owner] * BRICK, np.arange(len(voxels))
        side = 2 * self._reach + 1
        for begin in range(0, len(self._steps), _STEPS_AT_ONCE):
            at = inside[left, None] + self._steps[begin : begin + _STEPS_AT_ONCE]
            which = (at // BRICK + self._reach) @ np.array([side * side, side, 1])
            number = (at % BRICK) @ np.array([BRICK * BRICK, BRICK, 1])
            near = occupied[place[owner[left, None], which], number]
            left = left[~near.any(axis=1)]
        clear = np.zeros(len(voxels), np.bool_)
        clear[left] = True
        return clear


def stands_clear(voxels: NDArray[np.int32], surfaces: Surfaces, core: int = CORE_VOXELS) -> NDArray[np.bool_]:
    """True for the voxels, coordinates (n, 3), of a cluster of which at least ``core`` are clear of the
    surfaces, (n,)."""
    return _in_clusters(voxels, surfaces.clear(voxels), core)


def _in_clusters(voxels: NDArray[np.int32], marked: NDArray[np.bool_], core: int) -> NDArray[np.bool_]:
    """True for the voxels (n, 3) of a cluster of which at least ``core`` are ``marked`` (n,)."""
    cells, cell = np.unique(voxels // CELL_VOXELS, axis=0, return_inverse=True)
    cluster = find_clusters(cells)[0][cell.reshape(-1)]
    count = np.bincount(cluster[marked], minlength=len(cells))
    return np.asarray(count[cluster] >= core)


Verb = Literal["appeared", "left"]


@dataclass(frozen=True)
class ChangedThing:
    """Voxels that touch and changed in the same way: ``verb``, their number, and the upright box around them,
    ``lower_m`` and ``upper_m`` (3,) in metres, world."""

    verb: Verb
    voxels: int
    lower_m: NDArray[np.float64]
    upper_m: NDArray[np.float64]

    @property
    def size_m(self) -> NDArray[np.float64]:
        """Sides of the box, (3,) metres."""
        return self.upper_m - self.lower_m

    @property
    def centre_m(self) -> NDArray[np.float64]:
        """Centre of the box, (3,) metres, world."""
        return 0.5 * (self.lower_m + self.upper_m)


def _both_ways(
    change: MapChange, a: VoxelMap, b: VoxelMap
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.int32], VoxelMap, VoxelMap]]:
    """Of what appeared, and of what left: rows (n,) of the change, their voxels (n, 3), the map in which they
    are free, and the one in which they are occupied."""
    for before, after, free_in, occupied_in in ((FREE, OCCUPIED, a, b), (OCCUPIED, FREE, b, a)):
        rows = np.flatnonzero((change.before == before) & (change.after == after))
        yield rows, np.floor(change.points[rows] / a.voxel_size).astype(np.int32), free_in, occupied_in


def without_slack(change: MapChange, a: VoxelMap, b: VoxelMap, core: int = CORE_VOXELS) -> MapChange:
    """Voxels that appeared or left from map a to map b, without what can be a surface of the other map that
    has shifted a little: clusters of which fewer than ``core`` voxels are clear of those surfaces."""
    kept = np.zeros(len(change.points), np.bool_)
    for rows, voxels, free_in, _ in _both_ways(change, a, b):
        kept[rows] = stands_clear(voxels, Surfaces(free_in.view.pool, free_in.voxel_size), core)
    return _chosen(change, kept)


def _chosen(change: MapChange, kept: NDArray[np.bool_]) -> MapChange:
    """Some of the voxels that have changed."""
    return replace(
        change,
        points=change.points[kept],
        before=change.before[kept],
        after=change.after[kept],
        difference=change.difference[kept],
    )


def surely_changed(change: MapChange, a: VoxelMap, b: VoxelMap) -> MapChange:
    """Voxels that appeared or left, without clusters of which fewer than CORE_VOXELS are sure: occupied by
    their marginal, and in the map in which they are free clear of its surfaces and with only known voxels
    beside them. Where few rays of one keyframe vote for a surface, one ray at a slant makes the same place
    free, and at the edge of what a map has seen the surface of the other may begin in the next voxel."""
    kept = np.zeros(len(change.points), np.bool_)
    beside = a.voxel_size * np.concatenate([np.eye(3), -np.eye(3)])
    for rows, voxels, free_in, occupied_in in _both_ways(change, a, b):
        points = change.points[rows]
        sure = occupied_in.marginals.state(points) == OCCUPIED
        sure &= Surfaces(free_in.decided.view.pool, a.voxel_size).clear(voxels)
        for step in beside:
            sure &= free_in.state(points + step) != UNKNOWN
        kept[rows] = _in_clusters(voxels, sure, CORE_VOXELS)
    return _chosen(change, kept)


def find_changed_things(
    change: MapChange, voxel_size: float, min_voxels: int = 1, reach_m: float | None = None
) -> list[ChangedThing]:
    """Things that appeared (free before, occupied after) or left (occupied before, free after), the largest
    first, without clusters of less than ``min_voxels``. Space that was unknown before is new to the map, but
    need not be new.

    ``voxel_size`` is that of the maps, in metres. Voxels belong together if they touch; with ``reach_m`` also
    those in touching cells of that size (metres), so that the seen parts of one object are one thing.
    Raises ConfigError for min_voxels below 1 or reach_m below the voxel size.
    """
    reach = 1 if reach_m is None else round(reach_m / voxel_size)
    if reach < 1:
        raise ConfigError(f"reach_m must be at least the voxel size of {voxel_size:g} m, not {reach_m:g}")
    if min_voxels < 1:
        raise ConfigError(f"min_voxels must be at least 1, not {min_voxels}")
    things = []
    verbs: tuple[tuple[Verb, NDArray[np.float64]], ...]
    verbs = ("appeared", change.appeared), ("left", change.vanished)
    for verb, points in verbs:
        voxels = np.floor(points / voxel_size).astype(np.int32)
        cells, cell = np.unique(voxels // reach, axis=0, return_inverse=True)
        of_cells, _ = find_clusters(cells)
        cluster = of_cells[cell.reshape(-1)]
        for number in np.flatnonzero(np.bincount(cluster) >= min_voxels):
            mine = voxels[cluster == number]
            box = mine.min(axis=0) * voxel_size, (mine.max(axis=0) + 1) * voxel_size
            things.append(ChangedThing(verb, len(mine), *box))
    return sorted(things, key=lambda thing: -thing.voxels)


def things_between(change: MapChange, a: VoxelMap, b: VoxelMap) -> list[ChangedThing]:
    """Things that appeared or left between two maps of other views (:func:`compare_maps`), the largest first:
    those that are sure (:func:`surely_changed`), without sheets of less than three voxels, such as a table's
    top that one of the maps has seen at a slant only."""
    sure = surely_changed(change, a, b)
    things = find_changed_things(sure, a.voxel_size, CORE_VOXELS, max(PARTS_M, a.voxel_size))
    return [thing for thing in things if thing.size_m.min() > 2.5 * a.voxel_size]
