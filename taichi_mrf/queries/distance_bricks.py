"""The bricks of a distance field: made where there is a distance to keep, and worked out again where states
change.

A window of bricks around all that is known says where each one's distances are. Bricks of free or unknown
space that are further from all else than distances go need none. An update compares the states of the map
with those that it kept, and follows what differs along z, then y, then x, each time only from bricks whose
sums did change.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.queries.distance_grid import (
    COLUMNS,
    FAR,
    GONE,
    OUTSIDE,
    SAMPLES,
    SEEN_FREE,
    FieldGrid,
    SpaceRules,
    classify_bricks,
    copy_all,
    keep_classes,
    set_codes,
    take_slots,
)
from taichi_mrf.queries.distance_kernels import along_x, along_y, along_z, join_bricks
from taichi_mrf.queries.free import refused
from taichi_mrf.queries.known_bricks import BrickReader, Bricks, seen_free_bricks
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.resident import resident
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys

_BYTES_PER_BRICK = 4 * (COLUMNS + 2 * VOXELS + SAMPLES)
_MOST_BRICKS = 2**31 // SAMPLES - 1  # Taichi refuses arrays of 2^31 elements
_GROWTH = 1.2
_LEAST_CAPACITY = 256

BrickBox = tuple[NDArray[np.int64], NDArray[np.int64]]
"""The lowest brick of a box and the highest, (3,) each."""

Cells = NDArray[np.int32]
"""(n,) numbers of bricks in the window."""


class DistanceBricks:
    """The distances of a map's bricks, in a window of bricks that grows with the map.

    ``lowest`` (3,) is the window's first brick. ``values`` (slots * 729) are metres at the centres of voxels.
    """

    def __init__(self, rules: SpaceRules) -> None:
        self.rules = rules
        self._metres = resident(rules.metres)
        self.start_over()

    def start_over(self) -> None:
        """Forget all distances: the next update works out the whole field."""
        self.lowest = np.zeros(3, np.int64)
        self._codes = np.full((1, 1, 1), OUTSIDE, np.int32)
        self._known = np.zeros((0, 3), np.int32)
        self._free: list[int] = []
        self._capacity = 0
        self.classes, self._first, self._second = (ti.ndarray(ti.i32, 1) for _ in range(3))
        self.values = ti.ndarray(ti.f32, 1)
        self.grid = self._grid()

    @property
    def bytes(self) -> int:
        """Bytes of memory that distances and what they are made of take."""
        return self._capacity * _BYTES_PER_BRICK + 4 * self._codes.size

    def update(self, m: VoxelMap, within: BrickBox | None = None, most: float | None = None) -> int:
        """Take in the states of the map as they are now; returns how many voxels changed their distance.

        ``within``: only bricks in this box count. ``most``: free voxels whose log-odds are not below it are
        obstacles. Raises CapacityError.
        """
        m = m.decided
        bricks, sources = self._sources(m, within)
        if not len(bricks):
            return 0
        self._cover(bricks)
        cells = self._cells(bricks)
        view = m.view
        found, changed = ti.ndarray(ti.i32, len(cells) * COLUMNS), np.zeros(len(cells), np.int32)
        classify_bricks(
            view.pool.belief if most is None else refused(m, most),
            sources, cells, view.pool.prior_log_odds,
            view.volume.min_evidence, self.rules.unknown == "occupied", self.rules.unknown == "unknown",
            self.grid, found, changed,
        )  # fmt: skip
        rows = np.flatnonzero(changed).astype(np.int32)
        voxels = self._spread(cells[rows], rows, found) if len(rows) else 0
        self._known = bricks[sources != GONE]
        runtime.settle()
        return voxels

    def _sources(self, m: VoxelMap, within: BrickBox | None) -> tuple[Bricks, NDArray[np.int32]]:
        """The bricks (n, 3) that are known now or were at the last update, and where their states are
        (n,)."""
        reader = BrickReader(m)
        bricks = reader.bricks
        sources = reader.slots(bricks)
        if self.rules.unknown != "free":
            seen_free = seen_free_bricks(m)
            bricks = np.concatenate([bricks, seen_free])
            sources = np.concatenate([sources, np.full(len(seen_free), SEEN_FREE, np.int32)])
        if within is not None:
            inside = ((bricks >= within[0]) & (bricks <= within[1])).all(axis=1)
            bricks, sources = bricks[inside], sources[inside]
        gone = self._known[~np.isin(grid_keys(self._known), grid_keys(bricks), assume_unique=True)]
        gone_sources = np.full(len(gone), GONE, np.int32)
        return np.concatenate([bricks, gone]), np.concatenate([sources, gone_sources])

    def _spread(self, cells: Cells, rows: NDArray[np.int32], found: "ti.Ndarray") -> int:
        """Follow the new states ``found`` of some bricks; returns how many voxels changed their distance."""
        made = [self._make(cells)]
        keep_classes(found, rows, self._slots(cells), self.classes)
        stretch = range(-self.rules.reach_bricks, self.rules.reach_bricks + 1)
        column = self._beside(cells, 2, stretch)
        made.append(self._make(column))
        changed = np.zeros(len(column), np.int32)
        along_z(column, self.grid, self._first, changed)
        plane = self._beside(column[changed > 0], 1, stretch)
        made.append(self._make(plane))
        if len(plane):
            changed = np.zeros(len(plane), np.int32)
            along_y(plane, self.grid, self._first, self._second, changed)
            plane = plane[changed > 0]
        block = _union([self._beside(plane, 0, stretch), cells, *made])
        made.append(self._make(block))
        changed, counts = np.zeros((2, len(block)), np.int32)
        along_x(block, self.grid, self._second, self._metres, self.values, changed, counts)
        self._join(np.concatenate([block[changed > 0], *made]))
        return int(counts.sum())

    def _join(self, cells: Cells) -> None:
        """Let bricks before some bricks know of their distances, and give back those that need no slots."""
        if not len(cells):
            return
        for axis in range(3):
            cells = self._beside(cells, axis, (-1, 0))
        self._make(cells)
        far, outside = np.zeros((2, len(cells)), np.int32)
        far_m, outside_m = float(self.rules.metres[-1]), self.rules.outside_m
        join_bricks(cells, self.grid, self.values, far_m, outside_m, far, outside)
        codes = np.where(far == SAMPLES, FAR, np.where(outside == SAMPLES, OUTSIDE, 0)).astype(np.int32)
        self._drop(cells[codes < 0], codes[codes < 0])

    def _cells(self, bricks: Bricks) -> Cells:
        cells = np.ravel_multi_index(tuple((bricks - self.lowest).T), self._codes.shape)
        return np.asarray(cells, np.int32)

    def _slots(self, cells: Cells) -> NDArray[np.int32]:
        return self._codes.reshape(-1)[cells]

    def _beside(self, cells: Cells, axis: int, steps: "range | tuple[int, ...]") -> Cells:
        """Some bricks with those so many steps beside them along an axis, ascending. The window's margin
        holds them all."""
        across = int(np.prod(self._codes.shape[axis + 1 :]))
        return _union([cells + np.int32(step * across) for step in steps])

    def _cover(self, bricks: Bricks) -> None:
        """Let the window hold some bricks and all that their states can change. Raises CapacityError."""
        margin = self.rules.reach_bricks + 1
        lower, upper = bricks.min(axis=0) - margin, bricks.max(axis=0) + margin + 1
        old_lower, old_shape = self.lowest, np.array(self._codes.shape)
        if self._capacity:
            lower, upper = np.minimum(lower, old_lower), np.maximum(upper, old_lower + old_shape)
            if (lower == old_lower).all() and (upper == old_lower + old_shape).all():
                return
        shape = upper.astype(np.int64) - lower
        check_memory(4.0 * float(np.prod(shape.astype(np.float64))), f"distances in {shape.tolist()} bricks")
        codes = np.full(shape, OUTSIDE, np.int32)
        if self._capacity:
            place = tuple(slice(a, a + n) for a, n in zip(old_lower - lower, old_shape, strict=True))
            codes[place] = self._codes
        self.lowest, self._codes = lower.astype(np.int64), codes
        self.grid = self._grid()

    def _make(self, cells: Cells) -> Cells:
        """Give slots to those of some bricks that have none; returns these. Raises CapacityError."""
        codes = self._slots(cells)
        new = cells[codes < 0]
        if not len(new):
            return new
        if len(new) > len(self._free):
            self._grow(self._capacity + len(new) - len(self._free))
        slots = np.array(self._free[: -len(new) - 1 : -1], np.int32)
        del self._free[-len(new) :]
        far_m, outside_m = float(self.rules.metres[-1]), self.rules.outside_m
        take_slots(new, slots, self.grid, self._first, self._second, self.values, far_m, outside_m)
        self._codes.reshape(-1)[new] = slots
        return new

    def _drop(self, cells: Cells, codes: NDArray[np.int32]) -> None:
        """Give back the slots of bricks whose distances are all the same."""
        if len(cells):
            self._free += self._slots(cells).tolist()
            set_codes(cells, codes, self.grid)
            self._codes.reshape(-1)[cells] = codes

    def _grow(self, needed: int) -> None:
        if needed > _MOST_BRICKS:
            raise CapacityError(
                f"distances need {needed} bricks of {BRICK}^3 voxels, but at most "
                f"{_MOST_BRICKS} are possible; choose a smaller max_distance_m, a box, or larger voxels"
            )
        capacity = max(needed, min(_MOST_BRICKS, int(self._capacity * _GROWTH)), _LEAST_CAPACITY)
        check_memory(
            float(capacity) * _BYTES_PER_BRICK, f"distances in {capacity} bricks of {BRICK}^3 voxels"
        )
        for name, size in (
            ("classes", COLUMNS),
            ("_first", VOXELS),
            ("_second", VOXELS),
            ("values", SAMPLES),
        ):
            old = getattr(self, name)
            new = ti.ndarray(old.dtype, capacity * size)
            copy_all(old, new, self._capacity * size)
            runtime.settle()
            setattr(self, name, new)
        self.grid = replace(self.grid, classes=self.classes)
        self._free += range(capacity - 1, self._capacity - 1, -1)
        self._capacity = capacity

    def _grid(self) -> FieldGrid:
        runtime.settle()  # before the old index is dropped
        shape = ti.Vector(list(self._codes.shape), ti.i32)
        index = resident(self._codes.reshape(-1))  # on a CPU the codes themselves
        rules = self.rules
        return FieldGrid(shape, index, self.classes, rules.outside_class, rules.reach, rules.outside_square)


def _union(parts: list[Cells]) -> Cells:
    """Each of some bricks once, ascending. They are close together, so marks are sooner made than a sort."""
    parts = [part for part in parts if len(part)]
    if not parts:
        return np.zeros(0, np.int32)
    first, last = min(int(part.min()) for part in parts), max(int(part.max()) for part in parts)
    marks = np.zeros(last - first + 1, bool)
    for part in parts:
        marks[part - first] = True
    return np.flatnonzero(marks).astype(np.int32) + np.int32(first)
