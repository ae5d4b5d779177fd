"""Rules and storage of a distance field: which voxels of each brick are obstacles, what unknown space is, and
how far distances go.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.points import OCCUPIED, UNKNOWN, state_of
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array, I32Array, IVec3, IVec8, Template
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import within

UnknownSpace = Literal["free", "occupied", "unknown"]
"""Role of unknown voxels: no obstacles, obstacles, or no obstacles but without a distance themselves."""

MOST_REACH = 1024
"""Voxels that distances may reach, at most."""


@dataclass(frozen=True)
class SpaceRules:
    """Rules in voxels: the role of unknown space, the ``reach`` in voxels, and the distance in metres of each
    square of voxels, ``metres`` ((reach + 1)^2 + 1)."""

    unknown: UnknownSpace
    reach: int
    metres: NDArray[np.float32]

    @staticmethod
    def of(unknown: UnknownSpace, max_distance_m: float, voxel_size: float) -> "SpaceRules":
        """Distances to the faces of obstacles: half a voxel less than to their centres. Raises
        ConfigError."""
        reach = max(1, int(np.ceil(max_distance_m / voxel_size - 0.5)))
        if reach > MOST_REACH:
            raise ConfigError(
                f"max_distance_m must be at most {MOST_REACH} voxels, {MOST_REACH * voxel_size:g} m, "
                f"not {max_distance_m:g}"
            )
        squares = np.arange((reach + 1) ** 2 + 1, dtype=np.float64)
        metres = np.minimum((np.sqrt(squares) - 0.5) * voxel_size, max_distance_m)
        metres[-1] = max_distance_m
        return SpaceRules(unknown, reach, metres.astype(np.float32))

    @property
    def beyond(self) -> int:
        """The square that stands for all that is further than distances go."""
        return (self.reach + 1) ** 2

    @property
    def reach_bricks(self) -> int:
        """Bricks up to which a state can change a distance."""
        return -(-self.reach // BRICK)

    @property
    def outside_class(self) -> int:
        """A column of unknown voxels (distance_grid.FieldGrid)."""
        return {"free": 0, "occupied": 0x00FF, "unknown": 0xFF00}[self.unknown]

    @property
    def outside_square(self) -> int:
        """The squared distance deep in unknown space."""
        return -self.beyond if self.unknown == "occupied" else self.beyond

    @property
    def outside_m(self) -> float:
        """The distance there, in metres."""
        return -float(self.metres[-1]) if self.unknown == "occupied" else float(self.metres[-1])


OUTSIDE, FAR = -1, -2
"""In place of a slot: bricks of unknown space, and free ones, that are further from all else than distances
go."""

GONE, SEEN_FREE = -1, -2
"""In place of a slot in the map's pool: a brick that the map no longer has, and one that rays have crossed
and that has no voxels."""

COLUMNS = BRICK**2
"""Columns along z of a brick."""

SIDE = BRICK + 1
SAMPLES = SIDE**3
"""Distances that a brick keeps: those of its voxels and of the layer after them along each axis, so that what
lies between eight voxels is read from one brick."""

UNKNOWN_BITS, FLIPPED_BITS = 8, 16
ALL_BITS = (1 << BRICK) - 1
KEPT_BITS = (1 << FLIPPED_BITS) - 1
"""Bits of a column of voxels (FieldGrid.classes)."""


@dataclass(frozen=True)
class FieldGrid(Bundle):
    """Slots of a field's bricks, and the class of space without bricks."""

    shape: IVec3
    """Size of the window in bricks."""

    index: I32Array
    """(bricks of the window): the brick's slot in the field, OUTSIDE or FAR."""

    classes: I32Array
    """(slots * 64): for each column along z the obstacles in its lowest 8 bits, voxels whose distance is not
    known in the next 8, and those that have just become so, or known again, in the next 8."""

    outside_class: I32
    """The entry of ``classes`` for a column in unknown space."""

    reach: I32
    """Voxels to either side among which a minimum is taken."""

    outside: I32
    """The squared distance in unknown space, -(reach + 1)^2 where that is an obstacle."""

    @ti.func
    def slot(self, cell: IVec3):
        """The slot of a brick of the window, OUTSIDE or FAR."""
        slot = OUTSIDE
        if within(cell, self.shape):
            slot = self.index[flat(cell, self.shape)]
        return slot

    @ti.func
    def cell(self, number: I32):
        """The brick of the window with this number."""
        across = self.shape[1] * self.shape[2]
        return IVec3(number // across, number // self.shape[2] % self.shape[1], number % self.shape[2])

    @ti.func
    def column(self, cell: IVec3, number: I32):
        """Class of the voxels of a column of a brick."""
        slot = self.slot(cell)
        found = 0
        if slot >= 0:
            found = self.classes[slot * COLUMNS + number]
        elif slot == OUTSIDE:
            found = self.outside_class
        return found

    @ti.func
    def is_unknown(self, voxel: IVec3):
        """1 for a voxel of the window whose distance is not known."""
        column = self.column(voxel >> 3, (voxel[0] & 7) * BRICK + (voxel[1] & 7))
        return (column >> ((voxel[2] & 7) + UNKNOWN_BITS)) & 1

    @ti.func
    def column_of(self, sums: Template, cell: IVec3, number: I32) -> IVec8:
        """The values of ``sums`` (slots * 512) in a column of a brick."""
        slot = self.slot(cell)
        found = IVec8(self.outside)
        if slot >= 0:
            for k in ti.static(range(BRICK)):
                found[k] = sums[slot * VOXELS + number * BRICK + k]
        elif slot == FAR:
            found = IVec8((self.reach + 1) * (self.reach + 1))
        return found


@kernel
def classify_bricks(
    belief: F32Array, sources: I32Array, cells: I32Array, prior: F32, min_evidence: F32,
    obstacles_unknown: I32, distances_unknown: I32, grid: FieldGrid, found: I32Array, changed: I32Array,
) -> None:  # fmt: skip
    """Write the classes of the voxels of some bricks into ``found`` (n * 64), and 1 into ``changed`` (n) for
    the bricks that differ from ``grid.classes``.

    ``belief`` (pool * 512) are the map's log-odds, ``sources`` (n) the bricks' slots in its pool, GONE or
    SEEN_FREE, ``cells`` (n) their numbers in the window. ``obstacles_unknown`` and ``distances_unknown`` tell
    whether unknown voxels are obstacles, or have no distance.
    """
    for part in range(cells.shape[0] * COLUMNS):
        row, number = part // COLUMNS, part % COLUMNS
        column = grid.outside_class
        if sources[row] == SEEN_FREE:
            column = 0
        elif sources[row] >= 0:
            column = 0
            for k in range(BRICK):
                here = state_of(belief[sources[row] * VOXELS + number * BRICK + k], prior, min_evidence)
                if here == OCCUPIED or (here == UNKNOWN and obstacles_unknown == 1):
                    column |= 1 << k
                elif here == UNKNOWN and distances_unknown == 1:
                    column |= 1 << (k + UNKNOWN_BITS)
        found[part] = column
        if column != grid.column(grid.cell(cells[row]), number) & KEPT_BITS:
            changed[row] = 1


@kernel
def keep_classes(found: I32Array, rows: I32Array, slots: I32Array, classes: I32Array) -> None:
    """Copy the rows (k) of ``found`` (n * 64) to the bricks in ``slots`` (k) of ``classes`` (slots * 64)."""
    for part in range(rows.shape[0] * COLUMNS):
        row, number = part // COLUMNS, part % COLUMNS
        place, column = slots[row] * COLUMNS + number, found[rows[row] * COLUMNS + number]
        flipped = ((classes[place] ^ column) >> UNKNOWN_BITS) & ALL_BITS
        classes[place] = column | (flipped << FLIPPED_BITS)


@kernel
def take_slots(
    cells: I32Array, slots: I32Array, grid: FieldGrid, first: I32Array, second: I32Array, values: F32Array,
    far_m: F32, outside_m: F32,
) -> None:  # fmt: skip
    """Give bricks of the window, numbers (n), their ``slots`` (n), and say there what they were without one:
    OUTSIDE, or FAR. ``first`` and ``second`` (slots * 512) are squared distances, ``values`` (slots * 729)
    metres."""
    for part in range(cells.shape[0] * SAMPLES):
        row, k = part // SAMPLES, part % SAMPLES
        slot, column, square, metres = slots[row], 0, (grid.reach + 1) * (grid.reach + 1), far_m
        if grid.index[cells[row]] == OUTSIDE:
            column, square, metres = grid.outside_class, grid.outside, outside_m
        values[slot * SAMPLES + k] = metres
        if k < VOXELS:
            first[slot * VOXELS + k] = square
            second[slot * VOXELS + k] = square
        if k < COLUMNS:
            grid.classes[slot * COLUMNS + k] = column
    for row in range(cells.shape[0]):
        grid.index[cells[row]] = slots[row]


@kernel
def set_codes(cells: I32Array, codes: I32Array, grid: FieldGrid) -> None:
    """Say of bricks of the window, numbers (n), that they have no slots: ``codes`` (n), FAR or OUTSIDE."""
    for row in range(cells.shape[0]):
        grid.index[cells[row]] = codes[row]


@kernel
def copy_all(source: AnyArray, target: AnyArray, count: I32) -> None:
    """Copy the first ``count`` entries."""
    for i in range(count):
        target[i] = source[i]
