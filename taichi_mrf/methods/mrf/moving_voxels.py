"""The layers of a map whose evidence has a date: what moves, and all else."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.changed_things import Surfaces, stands_clear
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, F32Array, I32Array
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick
from taichi_mrf.voxels.numbering import strip_length
from taichi_mrf.voxels.pool import BrickPool, copied, write_bricks


@dataclass(frozen=True)
class Moving:
    """The dynamic voxels of a pool: the ``slots`` (n,) of their bricks, ascending, and which of the voxels
    they are, ``voxels`` (n, 512)."""

    slots: NDArray[np.int32]
    voxels: NDArray[np.bool_]

    @staticmethod
    def of(pool: BrickPool, shown: BrickPool, voxel_size: float) -> "Moving":
        """Moving voxels of a pool whose beliefs are those of ``shown``, the same bricks: they are occupied,
        although all evidence together makes them less likely than the prior, and stand clear of the surfaces
        of all evidence."""
        counts = np.zeros(max(1, pool.capacity), np.int32)
        _count_contradicted(pool.total, shown.belief, counts, pool.prior_log_odds)
        slots = pool.in_use
        slots = slots[counts[slots] > 0]
        moving: NDArray[np.bool_] = shown.read("belief", slots) >= 0
        moving &= pool.read("total", slots) < pool.prior_log_odds
        row, number = np.nonzero(moving)
        voxels = pool.bricks[slots[row]] * BRICK + offsets_in_brick()[number]
        moving[row, number] = stands_clear(voxels, Surfaces(pool, voxel_size, "total"))
        some = moving.any(axis=1)
        return Moving(slots[some], moving[some])


NOTHING_MOVES = Moving(np.zeros(0, np.int32), np.zeros((0, VOXELS), np.bool_))


def layer_of(pool: BrickPool, shown: "ti.Ndarray", dynamic: bool, voxel_size: float) -> "ti.Ndarray":
    """One layer of dated beliefs ``shown``, (capacity * 512): the dynamic one, or the static one. Where a
    voxel is dynamic the static layer reads all evidence together; everywhere else the dynamic one reads the
    prior."""
    then, out = pool.showing_others(shown), copied(shown)
    moving = Moving.of(pool, then, voxel_size)
    belief = then.read("belief", moving.slots)
    if dynamic:
        out.fill(pool.prior_log_odds)
        values = np.where(moving.voxels, belief, np.float32(pool.prior_log_odds))
    else:
        values = np.where(moving.voxels, pool.read("total", moving.slots), belief)
    if len(moving.slots):
        write_bricks(out, moving.slots, values.reshape(-1), strip_length())
    return out


@kernel
def _count_contradicted(total: F32Array, shown: F32Array, counts: I32Array, prior: F32) -> None:
    """Count, in each brick (capacity), the voxels that are occupied by ``shown``, although ``total`` makes
    them less likely than the prior; both are log-odds (capacity * 512)."""
    for i in range(shown.shape[0]):
        if shown[i] >= 0.0 and total[i] < prior:
            counts[i // VOXELS] += 1
