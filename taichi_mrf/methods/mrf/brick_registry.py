"""Which bricks a map has, who wants them, and who looks through them.

A brick exists as long as some keyframe has measured a surface in it, and is given back with the last
of them. Keyframes' footprints go in and out; nothing here knows what inference does with the voxels.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import Footprint, VisibleBricks
from taichi_mrf.voxels.layout import BRICK, grid_keys
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology

Bricks = NDArray[np.int32]

REMEMBERED = 64
"""Changes of the set of bricks that are kept, so that few lists must be made anew."""


class BrickRegistry:
    """Keeps topology and pool in step. ``version`` changes whenever a brick comes or goes."""

    def __init__(self, topology: Topology, pool: BrickPool, voxel_size: float) -> None:
        self.topology, self.pool, self.voxel_size = topology, pool, voxel_size
        self.version = 0
        self._changes: deque[Bricks] = deque(maxlen=REMEMBERED)
        self.frozen_crossed: Bricks = np.zeros((0, 3), np.int32)
        self._frozen_keys = np.zeros(0, np.int64)

    def claim(self, footprint: Footprint) -> None:
        """Allocate the bricks that a keyframe needs, and count it as an owner and as a looker.

        Raises CapacityError, before anything has changed, if there is no budget for them.
        """
        crossed = footprint.window.bricks_of(footprint.crossed)
        self.topology.check(crossed, self.voxel_size)
        surface = footprint.window.bricks_of(footprint.surface)
        slots = self.topology.slots(surface)
        missing = slots < 0
        if missing.any():
            slots[missing] = self.create(surface[missing])
        self.pool.owners[slots] += 1
        self.topology.add_crossings(crossed, 1)

    def anchor_at(self, position_m: NDArray[np.float64]) -> None:
        """Let the map lie around a position (3,) in the world, unless it already lies somewhere."""
        brick = np.floor(position_m / (self.voxel_size * BRICK))
        self.topology.anchor(np.clip(brick, -(2**30), 2**30).astype(np.int32))

    def restore(self, bricks: Bricks, owners: NDArray[np.int32] | int) -> NDArray[np.int32]:
        """The bricks of a saved map (n, 3), at least one, with so many owners each; returns their slots.

        Raises CapacityError if there is no budget for them.
        """
        self.topology.anchor(bricks[len(bricks) // 2])
        self.topology.check(bricks, self.voxel_size)
        slots = self.create(bricks)
        self.pool.owners[slots] = owners
        return slots

    def create(self, bricks: Bricks) -> NDArray[np.int32]:
        """New bricks (n, 3) at the prior, owned by nobody yet; returns their slots."""
        slots = self.pool.allocate(bricks)
        self.topology.insert(bricks, slots)
        self._note_change(bricks)
        return slots

    def disclaim(self, footprint: Footprint) -> None:
        """Undo :meth:`claim`; bricks that nobody owns any more are given back."""
        self.topology.add_crossings(footprint.window.bricks_of(footprint.crossed), -1)
        surface = footprint.window.bricks_of(footprint.surface)
        slots = self.topology.slots(surface)
        self.pool.owners[slots] -= 1
        orphans = self.pool.owners[slots] == 0
        if orphans.any():
            self.topology.erase(surface[orphans])
            self.pool.release(slots[orphans])
            self._note_change(surface[orphans])

    def freeze(self, footprint: Footprint) -> None:
        """Keep a footprint for good: its bricks stay, and what it crossed stays seen.

        All frozen keyframes count as one looker, so that their memory is bounded by the space they saw.
        """
        crossed = footprint.window.bricks_of(footprint.crossed)
        self.topology.add_crossings(crossed, -1)
        self.see_for_good(crossed)

    def see_for_good(self, bricks: Bricks) -> None:
        """Count bricks (n, 3), each given once, as crossed by what is frozen."""
        keys = grid_keys(bricks)
        order = np.argsort(keys)
        keys, bricks = keys[order], bricks[order]
        # Kept in order, so that a keyframe that is frozen costs what it sees and not what all before it saw.
        place = np.searchsorted(self._frozen_keys, keys)
        known = np.zeros(len(keys), bool)
        inside = place < len(self._frozen_keys)
        known[inside] = self._frozen_keys[place[inside]] == keys[inside]
        place, keys, bricks = place[~known], keys[~known], bricks[~known]
        self._frozen_keys = np.insert(self._frozen_keys, place, keys)
        self.frozen_crossed = np.insert(self.frozen_crossed, place, bricks, axis=0)
        self.topology.add_crossings(np.ascontiguousarray(bricks, np.int32), 1)

    def start_over(self) -> None:
        """Note that all bricks may have come or gone."""
        self.version += 1
        self._changes.clear()

    def visible_again(self, footprint: Footprint, old: VisibleBricks) -> VisibleBricks:
        """What a keyframe sees now that once saw ``old``: the same list, if none of the bricks that its rays
        cross has come or gone since, which costs no more than to look at those that have."""
        steps = self.version - old.version
        if steps > len(self._changes):
            return self.visible(footprint)
        for bricks in list(self._changes)[len(self._changes) - steps :]:
            cells = footprint.window.cells_of(bricks)
            place = np.minimum(np.searchsorted(footprint.crossed, cells), len(footprint.crossed) - 1)
            if len(footprint.crossed) and (footprint.crossed[place] == cells).any():
                return self.visible(footprint)
        old.version = self.version
        return old

    def _note_change(self, bricks: Bricks) -> None:
        self.version += 1
        self._changes.append(bricks)

    def visible(self, footprint: Footprint) -> VisibleBricks:
        """The bricks that exist among those that a keyframe's rays cross."""
        slots = self.topology.slots(footprint.window.bricks_of(footprint.crossed))
        exist = slots >= 0
        slots = slots[exist]
        return VisibleBricks(footprint.crossed[exist], slots, self.pool.identity[slots], self.version)
