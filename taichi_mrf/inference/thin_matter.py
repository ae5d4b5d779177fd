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
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.resident import zeros
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, IVec3, Template
from taichi_mrf.voxels.blended_field import AROUND, cell_of, voxel_around
from taichi_mrf.voxels.calls import MATTER, SUREST
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys, rows_around
from taichi_mrf.voxels.numbering import flat

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
    if not len(slots):
        return
    occupied = max(0.0, prior + min_evidence)
    slots = slots[np.argsort(grid_keys(bricks[slots]))]
    columns, found = zeros(np.int32, len(slots) * BRICK**2), np.zeros(len(slots), np.int32)
    _find_columns(slots, votes, log_odds, occupied, columns, found)
    doubted = np.flatnonzero(found).astype(np.int32)
    if not len(doubted):
        return
    around = rows_around(bricks[slots[doubted]], grid_keys(bricks[slots])).reshape(-1)
    verdicts = zeros(np.int32, len(slots) * VOXELS)  # _FREE
    voxels = _Voxels(slots, doubted, around, columns, votes, log_odds, occupied, *thin(voxel_size))
    _find_first(voxels, verdicts)
    for step in range(FOLLOWED):
        _follow(voxels, _MATTER + step, verdicts)
    _carry_out(verdicts, voxels, prior, prior - min_evidence, called(prior, min_evidence))
    runtime.settle()


def thin(voxel_size: float) -> tuple[int, int]:
    """The voxels around one, along two axes, in which a layer is looked at, and how many of them a thin thing
    fills at most. A brick and the 26 around it hold all that is looked at."""
    across = THIN_M / voxel_size
    reach = max(math.ceil(across) + 2, math.ceil(AROUND_M / voxel_size - 1e-9))
    return min(reach, BRICK), max(FEWEST, math.ceil(0.25 * math.pi * (across + 1) ** 2))


@dataclass(frozen=True)
class _Voxels(Bundle):
    """The voxels of the bricks with some in doubt, with those around them."""

    slots: I32Array
    """(bricks of the map) their slots in the pool."""

    doubted: I32Array
    """(places) rows of ``slots``."""

    around: I32Array
    """(places * 27) rows of the bricks in and around each, -1 for none."""

    columns: I32Array
    """(bricks of the map * 64): for each column along z the occupied voxels in its lowest 8 bits, and those
    with matter in the next 8."""

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
    def voxel(self, i: I32):
        """Place of the brick of the i-th voxel, its number in the pool, and that of its verdict."""
        place = i // VOXELS
        row = self.doubted[place]
        return place, self.slots[row] * VOXELS + i % VOXELS, row * VOXELS + i % VOXELS

    @ti.func
    def column(self, place: I32, cell: IVec3):
        """The column of a cell, counted from the first of the brick at ``place``, from -8 to 15."""
        row, bits = self.around[place * AROUND + flat((cell >> 3) + 1, IVec3(3))], 0
        if row >= 0:
            bits = self.columns[row * BRICK**2 + (cell[0] & 7) * BRICK + (cell[1] & 7)]
        return bits

    @ti.func
    def number_along_z(self, place: I32, cell: IVec3, within: I32, kind: Template):
        """The number of occupied voxels (``kind`` 0), or of those with matter (8), within some voxels of one
        in its column. The cell is in the brick's own layer along z."""
        bits = 0
        for k in ti.static(range(3)):
            here = self.column(place, IVec3(cell[0], cell[1], (k - 1) * BRICK)) >> kind
            bits |= (here & 0xFF) << (k * BRICK)
        mask = ((1 << (2 * within + 1)) - 1) << (cell[2] + BRICK - within)
        return ti.math.popcnt(bits & mask)

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
        while k < side * side and number <= limit:
            beside = cell + IVec3(k // side - within, k % side - within, 0)
            number += self.number_along_z(place, beside, within, 0)
            k += 1
        return number

    @ti.func
    def is_thin_layer(self, place: I32, cell: IVec3, axis: I32):
        """1 if the layer across an axis holds matter around a cell, and no more than a thin thing."""
        side, k, number = 2 * self.reach + 1, 0, 0
        if axis == 2:
            while k < side * side and number <= self.most:
                beside = cell + IVec3(k // side - self.reach, k % side - self.reach, 0)
                number += (self.column(place, beside) >> (BRICK + (cell[2] & 7))) & 1
                k += 1
        else:
            while k < side and number <= self.most:
                beside = cell
                beside[1 - axis] += k - self.reach
                number += self.number_along_z(place, beside, self.reach, BRICK)
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
def _find_columns(
    slots: I32Array, votes: I32Array, log_odds: F32Array, occupied: F32, columns: I32Array, found: I32Array
) -> None:
    """Write the ``columns`` (n * 64) of the bricks in ``slots`` (n) (_Voxels.columns), and mark the bricks in
    ``found`` (n) with a voxel that has a score and is not occupied."""
    for part in range(columns.shape[0]):
        row, column, doubted = part // BRICK**2, 0, 0
        for k in range(BRICK):
            voxel = slots[row] * VOXELS + part % BRICK**2 * BRICK + k
            is_occupied = ti.cast(log_odds[voxel] > occupied, ti.i32)
            has_score = ti.cast(votes[VOTES * voxel + 1] > 0, ti.i32)
            column |= (is_occupied | (is_occupied | has_score) << BRICK) << k
            doubted |= has_score & (1 - is_occupied)
        columns[part] = column
        if doubted == 1:
            found[row] = 1


@kernel
def _find_first(voxels: _Voxels, verdicts: I32Array) -> None:
    """The ``verdicts`` (bricks of the map * 512) on voxels: those in doubt, and of these the ones of thin
    things and of things that stand alone."""
    for i in range(voxels.doubted.shape[0] * VOXELS):
        place, voxel, verdict = voxels.voxel(i)
        score = voxels.tenths(voxel)
        if score >= 0 and voxels.votes[VOTES * voxel + 1] > 0:
            cell = cell_of(i % VOXELS)
            alone = voxels.occupied_near(place, cell, ALONE_WITHIN, ALONE) <= ALONE
            if alone or score >= BESIDE:
                verdicts[verdict] = _DOUBTED
            if score >= MATTER and (alone or voxels.is_on_a_rod(place, cell) == 1):
                verdicts[verdict] = _MATTER


@kernel
def _follow(voxels: _Voxels, last: I32, verdicts: I32Array) -> None:
    """Add voxels that touch those of a verdict up to ``last`` to the ``verdicts``."""
    for i in range(voxels.doubted.shape[0] * VOXELS):
        place, voxel, verdict = voxels.voxel(i)
        if verdicts[verdict] < _MATTER and voxels.tenths(voxel) >= MATTER:
            cell, touches = cell_of(i % VOXELS), 0
            for k in range(27):
                other = voxel_around(voxels.around, place, cell + IVec3(k // 9, k // 3 % 3, k % 3) - 1)
                if other >= 0:
                    touches |= ti.cast(_MATTER <= verdicts[other] <= last, ti.i32)
            if touches == 1 and voxels.occupied_near(place, cell, 1, FEW_BESIDE) <= FEW_BESIDE:
                verdicts[verdict] = last + 1


@kernel
def _carry_out(verdicts: I32Array, voxels: _Voxels, prior: F32, free_below: F32, least: F32) -> None:
    """Change the log-odds by the ``verdicts``."""
    for i in range(voxels.doubted.shape[0] * VOXELS):
        _, voxel, verdict = voxels.voxel(i)
        if verdicts[verdict] >= _MATTER:
            evidence = prior + 0.1 * (voxels.votes[VOTES * voxel + 1] // TWENTIETHS)
            voxels.log_odds[voxel] = ti.max(ti.min(evidence, SUREST), least)
        elif verdicts[verdict] == _DOUBTED and voxels.log_odds[voxel] < free_below:
            voxels.log_odds[voxel] = prior
