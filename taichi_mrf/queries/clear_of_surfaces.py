"""Which voxels a pose that is slightly off cannot explain: clusters that reach into free space.

Poses, noise and edges shift a surface by a voxel or two from view to view. What is occupied beside a surface
that was there before can be that surface; what stands out of it is something else.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.clusters import find_clusters
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys, rows_around
from taichi_mrf.voxels.pool import BrickPool

SLACK_VOXELS = 3
"""A surface may be so far from where it was, centre to centre."""

CORE_VOXELS = 8
"""A cluster of voxels is told of if so many of it are further than that from all surfaces."""

_BRICKS_AT_ONCE = 4096


def _ball() -> NDArray[np.int32]:
    steps = np.indices((2 * SLACK_VOXELS + 1,) * 3).reshape(3, -1).T.astype(np.int32) - SLACK_VOXELS
    return steps[(steps**2).sum(axis=1) <= SLACK_VOXELS**2]


_STEPS = _ball()


class Surfaces:
    """The occupied voxels of a pool, by its beliefs or by another ``channel``. Good for as long as no brick
    comes or goes."""

    def __init__(self, pool: BrickPool, channel: str = "belief") -> None:
        self._pool, self._channel = pool, channel
        slots = pool.in_use
        keys = grid_keys(pool.bricks[slots])
        order = np.argsort(keys)
        self._keys, self._slots = keys[order], np.append(slots[order], np.int32(-1))

    def _around(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]:
        """The slots of bricks (n, 3) and of the 26 around each, (n, 27); -1 where there is none."""
        return self._slots[rows_around(bricks, self._keys)]

    def clear(self, voxels: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Which voxels, coordinates (n, 3), have no surface within SLACK_VOXELS, (n,)."""
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
        """The same for voxels of some bricks (k, 3), each by its ``owner`` among them (n,)."""
        slots, place = np.unique(self._around(bricks), return_inverse=True)
        place = place.reshape(-1, 27)
        occupied = np.zeros((len(slots), VOXELS), np.bool_)
        occupied[slots >= 0] = self._pool.read(self._channel, slots[slots >= 0]) >= 0
        clear = np.ones(len(voxels), np.bool_)
        inside = voxels - bricks[owner] * BRICK
        for step in _STEPS:
            at = inside + step
            which = (at // BRICK + 1) @ np.array([9, 3, 1])
            number = (at % BRICK) @ np.array([BRICK * BRICK, BRICK, 1])
            clear &= ~occupied[place[owner, which], number]
        return clear


def stands_clear(voxels: NDArray[np.int32], surfaces: Surfaces, core: int = CORE_VOXELS) -> NDArray[np.bool_]:
    """Which voxels, coordinates (n, 3), are of a cluster that touches and of which at least ``core`` are
    clear of the surfaces, (n,)."""
    cluster, sizes = find_clusters(voxels)
    clear = np.bincount(cluster[surfaces.clear(voxels)], minlength=len(sizes))
    return np.asarray(clear[cluster] >= core)
