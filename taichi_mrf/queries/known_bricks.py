"""The known bricks of a map and the values of their voxels: what queries over space and exports are made of.
Every mapping method provides what is used here.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.points import FREE, classify
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels.layout import BRICK, CHUNK, VOXELS, grid_keys

Bricks = NDArray[np.int32]
"""(n, 3) brick coordinates in the world."""

BRICKS_AT_ONCE = 4096
"""Bricks that are read in one piece: 8 MB of log-odds."""

_POINTS_AT_ONCE = 1 << 20
_LEAST_PROBABILITY = 1e-9


class BrickReader:
    """Reads the voxels of bricks by their coordinates, also of those that have no voxels of their own.

    It is good for as long as no brick comes or goes.
    """

    def __init__(self, m: VoxelMap) -> None:
        self.map, self.pool = m, m.view.pool
        slots = self.pool.in_use
        keys = grid_keys(self.pool.bricks[slots])
        order = np.argsort(keys)
        self._keys, self._slots = keys[order], slots[order]

    @property
    def bricks(self) -> Bricks:
        """The bricks that have voxels, ascending."""
        return self.pool.bricks[self._slots]

    def slots(self, bricks: Bricks) -> NDArray[np.int32]:
        """Slots in the pool, (n, 3) -> (n,), -1 for bricks without voxels."""
        if not len(self._keys):
            return np.full(len(bricks), -1, np.int32)
        keys = grid_keys(bricks)
        rows = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where(self._keys[rows] == keys, self._slots[rows], np.int32(-1))

    def log_odds(self, bricks: Bricks) -> NDArray[np.float32]:
        """(n, 512) log-odds of being occupied; the same everywhere in a brick without voxels: the prior, or
        the value of seen-free space."""
        slots = self.slots(bricks)
        exist = slots >= 0
        out = np.empty((len(bricks), VOXELS), np.float32)
        out[exist] = self.pool.read("belief", slots[exist])
        out[~exist] = self._without_voxels(bricks[~exist])[:, None]
        return out

    def state(self, log_odds: NDArray[np.floating]) -> NDArray[np.int8]:
        """UNKNOWN, FREE or OCCUPIED for log-odds of this map, of any shape."""
        return classify(log_odds, self.pool.prior_log_odds, self.map.view.volume.min_evidence)

    def batches(self, bricks: Bricks) -> Iterator[tuple[Bricks, NDArray[np.float32], NDArray[np.int8]]]:
        """Some bricks in pieces of bounded size, each with its log-odds and states, (n, 512)."""
        for begin in range(0, len(bricks), BRICKS_AT_ONCE):
            piece = bricks[begin : begin + BRICKS_AT_ONCE]
            log_odds = self.log_odds(piece)
            yield piece, log_odds, self.state(log_odds)

    def _without_voxels(self, bricks: Bricks) -> NDArray[np.float32]:
        if not len(bricks):
            return np.zeros(0, np.float32)
        centres = brick_centres(bricks, self.map.voxel_size)
        log_odds = _log_odds_at(self.map, centres)
        free = self.state(log_odds) == FREE
        return np.where(free, log_odds, self.pool.prior_log_odds).astype(np.float32)


def seen_free_bricks(m: VoxelMap) -> Bricks:
    """Bricks (n, 3), ascending, that rays have crossed and in which no surface was measured: they are free
    and have no voxels of their own. Maps that integrate scan by scan keep voxels for all they have seen.

    They are looked for around the bricks that have voxels and the cameras, ever further out for as long as
    there are more of them.
    """
    box = _first_box(m)
    if box is None:
        return np.zeros((0, 3), np.int32)
    reader = BrickReader(m)
    while True:
        lower, upper = box[0] - CHUNK, box[1] + CHUNK
        found = _free_without_voxels(m, reader, lower, upper)
        if not len(found) or ((found > lower) & (found < upper)).all():
            return found
        box = np.minimum(box[0], found.min(axis=0)), np.maximum(box[1], found.max(axis=0))


def known_bricks(m: VoxelMap) -> Bricks:
    """All known bricks (n, 3), ascending: those with voxels and the seen-free."""
    return sorted_bricks(np.concatenate([BrickReader(m).bricks, seen_free_bricks(m)]))


def sorted_bricks(bricks: Bricks) -> Bricks:
    """Each brick once, ascending."""
    return bricks[np.unique(grid_keys(bricks), return_index=True)[1]]


def brick_centres(bricks: Bricks, voxel_size: float) -> NDArray[np.float64]:
    """Centres (n, 3) in metres, moved by half a voxel: the very middle is a corner of eight of them."""
    return (bricks.astype(np.float64) * BRICK + 0.5 * (BRICK + 1)) * voxel_size


def _first_box(m: VoxelMap) -> tuple[Bricks, Bricks] | None:
    """Lowest and highest brick with voxels or with a camera in it."""
    pool = m.view.pool
    brick_m = m.voxel_size * BRICK
    cameras = [np.floor(k.T_world_camera[:3, 3] / brick_m).astype(np.int32) for k in m.keyframes.values()]
    places = np.concatenate([pool.bricks[pool.in_use], np.array(cameras, np.int32).reshape(-1, 3)])
    return (places.min(axis=0), places.max(axis=0)) if len(places) else None


def _free_without_voxels(m: VoxelMap, reader: BrickReader, lower: Bricks, upper: Bricks) -> Bricks:
    """Seen-free bricks from ``lower`` to ``upper``, both included."""
    across = upper[1:] - lower[1:] + 1
    layers = max(1, _POINTS_AT_ONCE // int(np.prod(across, dtype=np.int64)))
    found = [np.zeros((0, 3), np.int32)]
    for first in range(int(lower[0]), int(upper[0]) + 1, layers):
        last = min(first + layers - 1, int(upper[0]))
        bricks = bricks_between(np.array([first, *lower[1:]]), np.array([last, *upper[1:]]))
        bricks = bricks[reader.slots(bricks) < 0]
        if len(bricks):
            log_odds = _log_odds_at(m, brick_centres(bricks, m.voxel_size))
            found.append(bricks[reader.state(log_odds) == FREE])
    return np.concatenate(found)


def _log_odds_at(m: VoxelMap, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log-odds of a map at points (N, 3) without voxels, which votes of rays say nothing of: (N,)."""
    p = np.maximum(m.marginals.occupancy(points_m).astype(np.float64), _LEAST_PROBABILITY)
    return np.asarray(np.log(p / (1 - p)))


def bricks_between(lower: NDArray[np.integer], upper: NDArray[np.integer]) -> Bricks:
    """All bricks (n, 3) from ``lower`` to ``upper``, both included, ascending."""
    shape = tuple((upper - lower + 1).tolist())
    return (np.indices(shape).reshape(3, -1).T + lower).astype(np.int32)
