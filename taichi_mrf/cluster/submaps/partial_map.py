"""An MRFMap of some of a sequence's keyframes, with the evidence of the others as given."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.messages import withdraw_messages
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.surfacing import measured_bricks
from taichi_mrf.queries.known_bricks import sorted_bricks
from taichi_mrf.system import runtime

Bricks = NDArray[np.int32]
"""(n, 3) brick coordinates in the world."""


class PartialMap(MRFMap):
    """Adds what rounds of exchange need: evidence of absent keyframes in, beliefs for other submaps out."""

    def assume(self, bricks: Bricks, evidence: NDArray[np.float32]) -> None:
        """Start inference in these bricks from these log-odds, (n, 512): the prior plus the messages of
        keyframes that are not in this map. Bricks in which only those have measured a surface are created."""
        topology = self._registry.topology
        topology.check(bricks, self.voxel_size)
        slots = topology.slots(bricks)
        missing = slots < 0
        if missing.any():
            slots[missing] = self._registry.create(bricks[missing])
        self._pool.owners[slots] += 1
        self._pool.write("evidence", slots, evidence)

    def beliefs(self, bricks: Bricks, without: Iterable[int] = ()) -> NDArray[np.float32]:
        """The log-odds in bricks that exist, (n, 3) -> (n, 512), less the messages of some keyframes, by id.
        Nothing may have been added or moved since the last :meth:`infer`."""
        slots = self._registry.topology.slots(bricks)
        snapshot = self._pool.snapshot(undated=True)
        for id in without:
            keyframe = self._keyframes[id]
            if keyframe.messages is not None:
                withdraw_messages(keyframe.visible, keyframe.messages, snapshot.belief)
        with self._pool.showing(snapshot):
            found = self._pool.read("belief", slots)
        runtime.settle()  # before the snapshot is dropped
        return found

    def slots(self, bricks: Bricks) -> NDArray[np.int32]:
        """Slots of bricks (n, 3) in the pool, (n,); -1 for those that do not exist."""
        return self._registry.topology.slots(bricks)

    def bricks(self) -> Bricks:
        """All bricks that exist, ascending."""
        return sorted_bricks(self._pool.bricks[self._pool.in_use])

    def seen_bricks(self, keyframes: Iterable[int]) -> Bricks:
        """The bricks that exist and that rays of any of these keyframes, by id, cross; ascending."""
        found = [
            k.footprint.window.bricks_of(k.visible.cells) for k in map(self._keyframes.get, keyframes) if k
        ]
        return sorted_bricks(np.concatenate([np.zeros((0, 3), np.int32), *found]))

    def all_crossed_bricks(self) -> Bricks:
        """The bricks that any ray crosses, whether they exist or not; ascending."""
        found = [k.footprint.window.bricks_of(k.footprint.crossed) for k in self._keyframes.values()]
        return sorted_bricks(np.concatenate([np.zeros((0, 3), np.int32), *found]))

    def measured_bricks(self) -> NDArray[np.int32]:
        """The bricks (n, 3) in which keyframes that are not frozen have a say in the surface; ascending."""
        return measured_bricks(self._parts)
