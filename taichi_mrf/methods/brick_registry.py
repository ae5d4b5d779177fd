"""Brick allocation and its two reference counts: owners and ray crossings.

A brick exists as long as at least one keyframe owns it, that is, has measured a surface in it or near it. How
many keyframes have seen most of a place (Footprint.seen) is counted for all bricks, allocated or not: seen
but not allocated means free. This module does not depend on what inference stores in the voxels.
"""

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.inference.keyframe import Cells, Footprint, VisibleBricks
from taichi_mrf.queries.points import checked_points
from taichi_mrf.voxels.layout import BRICK, CHUNK, grid_keys
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology

Bricks = NDArray[np.int32]

REMEMBERED = 64
"""Changes of the set of bricks that are remembered, with the bricks' slots, -1 for those that are gone. Lists
of visible bricks older than that are rebuilt."""


class BrickRegistry:
    """Keeps topology and pool consistent. ``version`` changes whenever bricks are allocated or released."""

    def __init__(self, topology: Topology, pool: BrickPool, voxel_size: float) -> None:
        self.topology, self.pool, self.voxel_size = topology, pool, voxel_size
        self.version = 0
        self._changes: deque[tuple[Bricks, NDArray[np.int32]]] = deque(maxlen=REMEMBERED)
        self.frozen_crossed: Bricks = np.zeros((0, 3), np.int32)
        self._frozen_keys = np.zeros(0, np.int64)
        self.before_claim: Callable[[Bricks], None] | None = None  # with the bricks (n, 3) to be crossed
        self.on_release: list[Callable[[Bricks], None]] = []  # with the bricks (n, 3) that are gone

    def claim(self, footprint: Footprint) -> VisibleBricks:
        """Allocate a keyframe's surface bricks and count its ownership and its crossings; returns what it
        sees then.

        Raises CapacityError if there is not enough memory; nothing has changed then.
        """
        crossed = footprint.window.bricks_of(footprint.crossed)
        self.topology.check(crossed, self.voxel_size)
        if self.before_claim is not None:
            self.before_claim(crossed)
        slots = self.topology.slots(crossed)
        surface = np.searchsorted(footprint.crossed, footprint.surface)
        missing = surface[slots[surface] < 0]
        if len(missing):
            slots[missing] = self.create(crossed[missing])
        self.pool.owners[slots[surface]] += 1
        self.topology.add_crossings(footprint.window.bricks_of(footprint.seen), 1)
        return self._list(footprint.crossed, slots)

    def anchor_at(self, position_m: NDArray[np.float64]) -> None:
        """Centre the volume on a position (3,) in the world, if its place is not fixed yet."""
        brick = np.floor(position_m / (self.voxel_size * BRICK))
        self.topology.anchor(np.clip(brick, -(2**30), 2**30).astype(np.int32))

    def places_of(self, points: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The slots (N,) of the bricks that hold points (N, 3) in metres, -1 for none, and the numbers (N,)
        of the voxels in these. Raises ConfigError for points of another shape or that are not finite."""
        places = np.floor(checked_points(points) / self.voxel_size)
        voxels = np.clip(places, -(2**30), 2**30).astype(np.int32)
        bricks = np.ascontiguousarray(voxels // BRICK)
        slots = self.topology.slots(bricks) if len(bricks) else np.zeros(0, np.int32)
        local = voxels - bricks * BRICK
        return slots, (local[:, 0] * BRICK + local[:, 1]) * BRICK + local[:, 2]

    def restore(self, bricks: Bricks, owners: NDArray[np.int32] | int) -> NDArray[np.int32]:
        """Allocate the bricks of a saved map, (n, 3) with n > 0, with their numbers of owners; returns their
        slots (n,). Raises CapacityError if there is not enough memory."""
        self.topology.anchor(bricks[len(bricks) // 2])
        self.topology.check(bricks, self.voxel_size)
        slots = self.create(bricks)
        self.pool.owners[slots] = owners
        return slots

    def create(self, bricks: Bricks) -> NDArray[np.int32]:
        """Allocate bricks (n, 3) at the prior, without owners; returns their slots (n,)."""
        slots = self.pool.allocate(bricks)
        self.topology.insert(bricks, slots)
        self._note_change(bricks, slots)
        return slots

    def disclaim(self, footprint: Footprint) -> None:
        """Undo :meth:`claim` and release the bricks that are left without an owner."""
        self.topology.add_crossings(footprint.window.bricks_of(footprint.seen), -1)
        surface = footprint.window.bricks_of(footprint.surface)
        slots = self.topology.slots(surface)
        self.pool.owners[slots] -= 1
        orphans = self.pool.owners[slots] == 0
        if orphans.any():
            self._release(slots[orphans])

    def freeze(self, footprint: Footprint) -> None:
        """Keep a footprint for good: its bricks stay allocated, and what it has seen stays seen.

        All frozen keyframes share one crossing count, which bounds their memory by the space that they saw.
        """
        seen = footprint.window.bricks_of(footprint.seen)
        self.topology.add_crossings(seen, -1)
        self.see_for_good(seen)

    def see_for_good(self, bricks: Bricks) -> None:
        """Count bricks (n, 3), without repetitions, as seen by frozen keyframes."""
        keys = grid_keys(bricks)
        order = np.argsort(keys)
        keys, bricks = keys[order], bricks[order]
        # Sorted, so that freezing a keyframe costs as much as it sees and not as much as all frozen ones saw.
        place = np.searchsorted(self._frozen_keys, keys)
        known = np.zeros(len(keys), bool)
        inside = place < len(self._frozen_keys)
        known[inside] = self._frozen_keys[place[inside]] == keys[inside]
        place, keys, bricks = place[~known], keys[~known], bricks[~known]
        self._frozen_keys = np.insert(self._frozen_keys, place, keys)
        self.frozen_crossed = np.insert(self.frozen_crossed, place, bricks, axis=0)
        self.topology.add_crossings(np.ascontiguousarray(bricks, np.int32), 1)

    def leave(self, slots: NDArray[np.int32], chunks: NDArray[np.int32]) -> None:
        """Release all that frozen keyframes have left in chunks (n, 3), which no other keyframe's rays cross:
        the bricks in ``slots``, and what was crossed."""
        if len(slots):
            self._release(slots)
        inside = np.isin(grid_keys(self.frozen_crossed // CHUNK), grid_keys(chunks))
        self.topology.add_crossings(self.frozen_crossed[inside], -1)
        self.frozen_crossed, self._frozen_keys = self.frozen_crossed[~inside], self._frozen_keys[~inside]
        self.topology.drop_chunks(chunks)

    def start_over(self) -> None:
        """Mark all lists of visible bricks as outdated."""
        self.version += 1
        self._changes.clear()

    def visible_again(self, footprint: Footprint, old: VisibleBricks) -> VisibleBricks:
        """The keyframe's visible bricks now: ``old`` itself if none of the bricks that its rays cross was
        allocated or released since. Only the changes since then are looked at."""
        steps = self.version - old.version
        if steps > len(self._changes):
            return self.visible(footprint)
        changes = []
        for bricks, slots in list(self._changes)[len(self._changes) - steps :]:
            cells = footprint.window.cells_of(bricks)
            place = np.searchsorted(footprint.crossed, cells)
            crossed = (np.append(footprint.crossed, -1)[place] == cells) & (cells >= 0)
            changes.append((cells[crossed], slots[crossed]))
        if not any(len(cells) for cells, _ in changes):
            old.version = self.version
            return old
        # The last change of a brick comes first, and is the one that np.unique takes.
        cells, slots = (np.concatenate(each)[::-1] for each in zip(*changes, strict=True))
        cells, last = np.unique(cells, return_index=True)
        return self._list(*_merged(old.cells, old.slots, cells, slots[last]))

    def _release(self, slots: NDArray[np.int32]) -> None:
        """Release bricks, which no keyframe owns any more."""
        bricks = self.pool.bricks[slots]
        self.topology.erase(bricks)
        self.pool.release(slots)
        self._note_change(bricks, np.full(len(bricks), -1, np.int32))
        for forget in self.on_release:
            forget(bricks)

    def _note_change(self, bricks: Bricks, slots: NDArray[np.int32]) -> None:
        self.version += 1
        self._changes.append((bricks, slots))

    def visible(self, footprint: Footprint) -> VisibleBricks:
        """The allocated bricks among those that a keyframe's rays cross."""
        slots = self.topology.slots(footprint.window.bricks_of(footprint.crossed))
        return self._list(footprint.crossed, slots)

    def _list(self, cells: Cells, slots: NDArray[np.int32]) -> VisibleBricks:
        """Those of some bricks, cells with their slots, that exist."""
        exist = slots >= 0
        cells, slots = cells[exist], slots[exist]
        return VisibleBricks(cells, slots, self.pool.identity[slots], self.version)


def _merged(
    cells: Cells, slots: NDArray[np.int32], other_cells: Cells, other_slots: NDArray[np.int32]
) -> tuple[Cells, NDArray[np.int32]]:
    """A list of bricks, ascending cells with their slots, in which some have other slots, -1 for none."""
    place = np.searchsorted(cells, other_cells)
    listed = np.append(cells, -1)[place] == other_cells
    slots = slots.copy()
    slots[place[listed]] = other_slots[listed]
    place, other_cells, other_slots = place[~listed], other_cells[~listed], other_slots[~listed]
    return np.insert(cells, place, other_cells), np.insert(slots, place, other_slots)
