"""The space that rays go through, unknown space included: for queries in which that stops a ray or counts.

The index of a window (voxels/window.py) names the bricks that exist. Here it also names, by the slot behind
the pool's last, every brick that no ray has crossed, so that a ray meets its voxels as it meets others;
what was seen to be free and has no voxels stays out of the index and is skipped.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.known_bricks import BrickReader, seen_free_bricks
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys
from taichi_mrf.voxels.window import Window


class RaySpace:
    """A map's known and unknown space. It is good for as long as the map does not change."""

    def __init__(self, m: VoxelMap) -> None:
        self.map = m
        self._reader = BrickReader(m)
        self._free = seen_free_bricks(m)
        self._free_keys = grid_keys(self._free)

    @property
    def unknown_from(self) -> int:
        """Voxels of the index from this number on are those of bricks that no ray has crossed."""
        return self._reader.pool.capacity * VOXELS

    def known_box_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Two corners, in metres, around all bricks that are known, and a layer of unknown ones; None if the
        map is empty."""
        known = np.concatenate([self._reader.bricks, self._free])
        if not len(known):
            return None
        brick_m = self.map.voxel_size * BRICK
        return (known.min(axis=0) - 1) * brick_m, (known.max(axis=0) + 2) * brick_m

    @contextmanager
    def indexed(self, lower_m: NDArray[np.float64], upper_m: NDArray[np.float64]) -> Iterator[Window]:
        """A window around a box in metres, which stands in ``map.view.index`` while the block runs.

        Raises CapacityError if the box has too many bricks.
        """
        window = Window.covering(lower_m, upper_m, self.map.voxel_size)
        cells = np.arange(window.cells, dtype=np.int32)
        bricks = window.bricks_of(cells)
        slots = self._reader.slots(bricks)
        unknown = (slots < 0) & ~np.isin(grid_keys(bricks), self._free_keys)
        slots[unknown] = self._reader.pool.capacity
        there = slots >= 0
        index = self.map.view.index
        index.fill(window, cells[there], slots[there])
        try:
            yield window
        finally:
            index.clear(window, cells[there])
            runtime.settle()
