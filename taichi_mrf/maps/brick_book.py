"""Which bricks a map has, who wants them, and who looks through them.

A brick exists as long as some keyframe has measured a surface in it, and is given back with the last
of them. Keyframes' footprints go in and out; nothing here knows what inference does with the voxels.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import Footprint, VisibleBricks
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology

Bricks = NDArray[np.int32]


class BrickBook:
    """Keeps topology and pool in step. ``version`` changes whenever a brick comes or goes."""

    def __init__(self, topology: Topology, pool: BrickPool, voxel_size: float) -> None:
        self.topology, self.pool, self.voxel_size = topology, pool, voxel_size
        self.version = 0
        self.frozen_crossed: Bricks = np.zeros((0, 3), np.int32)

    def claim(self, footprint: Footprint) -> None:
        """Allocate the bricks that a keyframe needs, and count it as an owner and as a looker.

        Raises CapacityError, before anything has changed, if there is no room for them.
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

    def create(self, bricks: Bricks) -> NDArray[np.int32]:
        """New bricks (n, 3) at the prior, owned by nobody yet; returns their slots."""
        slots = self.pool.allocate(bricks)
        self.topology.insert(bricks, slots)
        self.version += 1
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
            self.version += 1

    def freeze(self, footprint: Footprint) -> None:
        """Keep a footprint for good: its bricks stay, and what it crossed stays seen.

        All frozen keyframes count as one looker, so that their memory is bounded by the space they saw.
        """
        crossed = footprint.window.bricks_of(footprint.crossed)
        self.topology.add_crossings(crossed, -1)
        self.see_for_good(crossed)

    def see_for_good(self, bricks: Bricks) -> None:
        """Count bricks as crossed by what is frozen."""
        together = np.unique(np.concatenate([self.frozen_crossed, bricks]), axis=0)
        self.topology.add_crossings(self.frozen_crossed, -1)
        self.frozen_crossed = np.ascontiguousarray(together, np.int32)
        self.topology.add_crossings(self.frozen_crossed, 1)

    def visible(self, footprint: Footprint) -> VisibleBricks:
        """The bricks that exist among those that a keyframe's rays cross."""
        slots = self.topology.slots(footprint.window.bricks_of(footprint.crossed))
        exist = slots >= 0
        slots = slots[exist]
        return VisibleBricks(footprint.crossed[exist], slots, self.pool.identity[slots], self.version)
