"""Memory for the keyframes of a map, checked as each is added.

Messages need most of the memory and are allocated only during inference. The check when a keyframe is added
reserves it, so that a long run does not fail at its end. A keyframe is counted with the bricks that it saw
when it was added; bricks that become visible later add little. Totals are kept as sums, so a check costs the
same however many keyframes there are.
"""

from dataclasses import dataclass

from taichi_mrf.inference.keyframe import Footprint, Keyframe
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool


@dataclass(frozen=True)
class _Share:
    """Bytes of one keyframe's messages and of its image."""

    messages: int
    image: int


class MemoryBudget:
    """The memory that the keyframes of a map need, and whether one more fits."""

    def __init__(self, pool: BrickPool, precision: str) -> None:
        """``precision`` is that of the messages, float16 or float32."""
        self._pool = pool
        self._bytes_per_brick = VOXELS * (2 if precision == "float16" else 4)
        self._shares: dict[int, _Share] = {}
        self._unallocated: set[int] = set()  # keyframes whose messages are not allocated yet
        self._messages = self._images = self._reserved = 0

    def check(self, added: Footprint, image_bytes: int) -> None:
        """Raise CapacityError if the map with one more keyframe and all messages exceeds the pool's limit, or
        if the messages that are not allocated yet exceed the free memory.

        Only the bricks near its own surfaces are counted for the keyframe to be added.
        """
        own = len(added.surface) * self._bytes_per_brick
        what = f"a map of {len(self._shares) + 1} keyframes with their messages"
        if self._pool.memory_limit_gb > 0:
            voxels = len(self._pool.in_use) * VOXELS * self._pool.bytes_per_voxel
            wanted = voxels + self._images + image_bytes + self._messages + own
            check_memory(wanted, what, self._pool.memory_limit_gb)
        check_memory(self._reserved + own, what)

    def take(self, keyframe: Keyframe) -> None:
        """Count a keyframe, whose messages are not allocated yet."""
        share = _Share(len(keyframe.visible.slots) * self._bytes_per_brick, keyframe.image_bytes)
        self._shares[keyframe.id] = share
        self._messages, self._images = self._messages + share.messages, self._images + share.image
        self.mark_unallocated(keyframe.id)

    def mark_allocated(self, id: int) -> None:
        """The keyframe's messages are allocated: release the memory reserved for them."""
        if id in self._unallocated:
            self._unallocated.remove(id)
            self._reserved -= self._shares[id].messages

    def mark_unallocated(self, id: int) -> None:
        """The keyframe's messages are not allocated: reserve memory for them."""
        if id not in self._unallocated:
            self._unallocated.add(id)
            self._reserved += self._shares[id].messages

    def give_back(self, id: int) -> None:
        """Remove a keyframe from the count."""
        self.mark_allocated(id)
        share = self._shares.pop(id)
        self._messages, self._images = self._messages - share.messages, self._images - share.image
