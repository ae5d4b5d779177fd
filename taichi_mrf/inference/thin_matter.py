"""Voxels that are partly full: where rays end that most others pass, by the scores of surface_votes.py.

A voxel with a score above 0 holds matter, and so does an occupied one. It is not called free; around a
larger thing, whose noise reaches further than its surface, only from a score of BESIDE on. It is called
occupied only where the matter is thin, or stands alone: the voxels that a larger surface cuts have ends as
well, and walls would grow by a voxel. The first voxels are those with a score of MATTER whose surroundings
within ALONE_WITHIN voxels hold few that the marginals call occupied, and those on a rod: in a row of layers
across an axis, the matter in a square around the voxel is no more than a thing of THIN_M fills. From there
the thing is followed for two voxels, into what it stands on.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.brick_sums import VOTES
from taichi_mrf.inference.surface_votes import called
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, IVec3
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.blended_field import cell_of, voxel_around
from taichi_mrf.voxels.calls import MATTER, SUREST
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys, rows_around

TWENTIETHS = 2
"""Twentieths of a nat, the unit of scores, in a tenth, that of MATTER."""

BESIDE = 60
"""Score, in tenths of a nat, from which on a voxel is not called free beside a larger thing."""

ALONE, ALONE_WITHIN = 3, 3
"""Occupied voxels at most, within so many voxels, around a thing that stands alone."""

THIN_M = 0.07
"""Thickness up to which a thing is thin."""

AROUND_M = 0.16
"""There is nothing else so far around it. What fringes the edge of a larger thing looks like a rod itself."""

FEWEST = 4
"""Voxels of a layer that a thing may fill at least: the thinnest one lies in four where it meets an edge. A
thicker one is round, and may fill as many as a circle with a voxel more across."""

FOLLOWED, FEW_BESIDE = 2, 3
"""Voxels that a thin thing is followed for, and how many occupied ones such a voxel may touch."""

_FREE, _DOUBTED, _MATTER = 0, 1, 2
"""Verdicts. A voxel that is followed has _MATTER plus the number of its step."""


def call_matter(
    votes: "ti.Ndarray",
    log_odds: "ti.Ndarray",
    bricks: NDArray[np.int32],
    slots: NDArray[np.int32],
    voxel_size: float,
    prior: float,
    min_evidence: float,
) -> None:
    """Change the ``log_odds`` (n), by which voxels have their states, where the scores among the ``votes``
    (n * VOTES) say that there is matter. An occupied voxel gets those of its score, one in doubt that was
    free the prior, which is unknown. ``bricks`` (capacity, 3) are those of the map, in ``slots`` (m)."""
    occupied = max(0.0, prior + min_evidence)
    slots = slots[np.argsort(grid_keys(bricks[slots]))]
    found = np.zeros(len(slots), np.int32)
    _find_doubted(slots, votes, log_odds, occupied, found)
    doubted = slots[np.flatnonzero(found)]
    if not len(doubted):
        return
    around = rows_around(bricks[doubted], grid_keys(bricks[slots]))
    around = np.where(around >= 0, slots[around], -1).astype(np.int32)
    verdicts = ti.ndarray(ti.i32, log_odds.shape)
    verdicts.fill(_FREE)
    voxels = _Voxels(around.reshape(-1), votes, log_odds, occupied, *thin(voxel_size))
    _find_first(doubted, voxels, verdicts)
    for step in range(FOLLOWED):
        _follow(doubted, voxels, _MATTER + step, verdicts)
    _carry_out(doubted, verdicts, voxels, prior, prior - min_evidence, called(prior, min_evidence))
    runtime.settle()


def thin(voxel_size: float) -> tuple[int, int]:
    """The voxels around one, along two axes, in which a layer is looked at, and how many of them a thin thing
    fills at most. A brick and the 26 around it hold all that is looked at."""
    across = THIN_M / voxel_size
    reach = max(math.ceil(across) + 2, math.ceil(AROUND_M / voxel_size - 1e-9))
    return min(reach, BRICK), max(FEWEST, math.ceil(0.25 * math.pi * (across + 1) ** 2))


@dataclass(frozen=True)
class _Voxels(Bundle):
    """The voxels of some bricks, with those around them."""

    around: I32Array
    """(bricks * 27) slots of the bricks in and around each, -1 for none."""

    votes: I32Array
    """(pool * 512 * VOTES)"""

    log_odds: F32Array
    """(pool * 512)"""

    occupied: F32
    """Voxels above these log-odds are."""

    reach: I32
    most: I32
    """As :func:`thin` has them."""

    @ti.func
    def is_occupied(self, place: I32, cell: IVec3):
        """1 if a cell, counted from the first of the brick at ``place``, is an occupied voxel."""
        voxel, yes = voxel_around(self.around, place, cell), 0
        if voxel >= 0:
            yes = ti.cast(self.log_odds[voxel] > self.occupied, ti.i32)
        return yes

    @ti.func
    def has_matter(self, place: I32, cell: IVec3):
        """1 if it is one, or has a score above 0."""
        voxel, yes = voxel_around(self.around, place, cell), 0
        if voxel >= 0:
            yes = ti.cast(self.votes[VOTES * voxel + 1] > 0 or self.log_odds[voxel] > self.occupied, ti.i32)
        return yes

    @ti.func
    def tenths(self, voxel: I32):
        """The score of a voxel, in tenths of a nat, -1 for an occupied one."""
        score = self.votes[VOTES * voxel + 1] // TWENTIETHS
        if self.log_odds[voxel] > self.occupied:
            score = -1
        return score

    @ti.func
    def occupied_near(self, place: I32, cell: IVec3, within: I32, limit: I32):
        """The number of occupied voxels within some voxels of one, counted up to above the limit."""
        side, k, number = 2 * within + 1, 0, 0
        while k < side * side * side and number <= limit:
            step = IVec3(k // (side * side), k // side % side, k % side) - within
            number += self.is_occupied(place, cell + step)
            k += 1
        return number

    @ti.func
    def is_thin_layer(self, place: I32, cell: IVec3, axis: I32):
        """1 if the layer across an axis holds matter around a cell, and no more than a thin thing."""
        side, k, number = 2 * self.reach + 1, 0, 0
        while k < side * side and number <= self.most:
            u, v = k // side - self.reach, k % side - self.reach
            step = IVec3(0, u, v)
            if axis == 1:
                step = IVec3(u, 0, v)
            elif axis == 2:
                step = IVec3(u, v, 0)
            number += self.has_matter(place, cell + step)
            k += 1
        return ti.cast(number > 0 and number <= self.most, ti.i32)

    @ti.func
    def is_on_a_rod(self, place: I32, cell: IVec3):
        """1 if ``reach`` + 1 layers in a row, the cell's among them, are thin."""
        axis, found = 0, 0
        while axis < 3 and found == 0:
            along = IVec3(ti.cast(axis == 0, ti.i32), ti.cast(axis == 1, ti.i32), ti.cast(axis == 2, ti.i32))
            row, step, forth = 0, 0, 1
            while forth != 0:
                thin_here = 0
                if ti.abs(step) <= self.reach:
                    thin_here = self.is_thin_layer(place, cell + step * along, axis)
                row += thin_here
                if thin_here == 1:
                    step += forth
                elif forth == 1 and step > 0:
                    step, forth = -1, -1
                else:
                    forth = 0
                if row > self.reach:
                    found, forth = 1, 0
            axis += 1
        return found


@kernel
def _find_doubted(
    slots: I32Array, votes: I32Array, log_odds: F32Array, occupied: F32, found: I32Array
) -> None:
    """Mark the bricks in ``slots`` (n) with a voxel that has a score and is not occupied."""
    for i in range(slots.shape[0]):
        doubted = 0
        for k in range(VOXELS):
            voxel = slots[i] * VOXELS + k
            if votes[VOTES * voxel + 1] > 0 and log_odds[voxel] <= occupied:
                doubted = 1
        found[i] = doubted


@kernel
def _find_first(slots: I32Array, voxels: _Voxels, verdicts: I32Array) -> None:
    """The verdicts (pool * 512) on the voxels of the bricks in ``slots`` (n): those in doubt, and of these
    the ones of thin things and of things that stand alone."""
    for i in range(slots.shape[0] * VOXELS):
        place, voxel = i // VOXELS, slots[i // VOXELS] * VOXELS + i % VOXELS
        score = voxels.tenths(voxel)
        if score >= 0 and voxels.votes[VOTES * voxel + 1] > 0:
            cell = cell_of(i % VOXELS)
            alone = voxels.occupied_near(place, cell, ALONE_WITHIN, ALONE) <= ALONE
            if alone or score >= BESIDE:
                verdicts[voxel] = _DOUBTED
            if score >= MATTER and (alone or voxels.is_on_a_rod(place, cell) == 1):
                verdicts[voxel] = _MATTER


@kernel
def _follow(slots: I32Array, voxels: _Voxels, last: I32, verdicts: I32Array) -> None:
    """Add voxels that touch those of a verdict up to ``last`` to the ``verdicts`` (pool * 512)."""
    for i in range(slots.shape[0] * VOXELS):
        place, voxel = i // VOXELS, slots[i // VOXELS] * VOXELS + i % VOXELS
        if verdicts[voxel] < _MATTER and voxels.tenths(voxel) >= MATTER:
            cell, touches = cell_of(i % VOXELS), 0
            for k in range(27):
                other = voxel_around(voxels.around, place, cell + IVec3(k // 9, k // 3 % 3, k % 3) - 1)
                if other >= 0:
                    touches |= ti.cast(_MATTER <= verdicts[other] <= last, ti.i32)
            if touches == 1 and voxels.occupied_near(place, cell, 1, FEW_BESIDE) <= FEW_BESIDE:
                verdicts[voxel] = last + 1


@kernel
def _carry_out(
    slots: I32Array, verdicts: I32Array, voxels: _Voxels, prior: F32, free_below: F32, least: F32
) -> None:
    """Change the log-odds by the ``verdicts`` (pool * 512) on the bricks in ``slots`` (n)."""
    for i in range(slots.shape[0] * VOXELS):
        voxel = slots[i // VOXELS] * VOXELS + i % VOXELS
        if verdicts[voxel] >= _MATTER:
            evidence = prior + 0.1 * (voxels.votes[VOTES * voxel + 1] // TWENTIETHS)
            voxels.log_odds[voxel] = ti.max(ti.min(evidence, SUREST), least)
        elif verdicts[voxel] == _DOUBTED and voxels.log_odds[voxel] < free_below:
            voxels.log_odds[voxel] = prior
