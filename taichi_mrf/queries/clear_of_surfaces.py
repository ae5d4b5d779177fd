"""Voxels that a pose that is slightly off cannot explain: clusters that reach into free space.

Poses, noise and edges shift a surface by some centimetres from view to view. What is occupied beside a
surface that was there before can be that surface; what stands out of it is something else.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.clusters import find_clusters
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
    cells, cell = np.unique(voxels // CELL_VOXELS, axis=0, return_inverse=True)
    cluster = find_clusters(cells)[0][cell.reshape(-1)]
    clear = np.bincount(cluster[surfaces.clear(voxels)], minlength=len(cells))
    return np.asarray(clear[cluster] >= core)
