"""Whether there is memory for the keyframes of a map: asked as each is added, so that inference, which takes
most of the memory, does not end for the lack of it what took hours.

A keyframe's bricks are those that it saw when it was added: what comes later in its view adds a little. What
all of them take is kept as sums, so that a new keyframe costs no more beside thousands of others.
"""

from dataclasses import dataclass

from taichi_mrf.inference.keyframe import Footprint, Keyframe
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool


@dataclass(frozen=True)
class _Share:
    """Bytes of one keyframe: of its messages, and of its image."""

    messages: int
    image: int


class MemoryBudget:
    """What the keyframes of a map take, and whether one more fits."""

    def __init__(self, pool: BrickPool, precision: str) -> None:
        """``precision`` is that of the messages."""
        self._pool = pool
        self._bytes_per_brick = VOXELS * (2 if precision == "float16" else 4)
        self._shares: dict[int, _Share] = {}
        self._silent: set[int] = set()  # those that have no messages
        self._messages = self._images = self._to_come = 0

    def check(self, added: Footprint, image_bytes: int) -> None:
        """Raise CapacityError if the map with one more keyframe, all of them with their messages, is over the
        pool's limit, or if the messages that are still to come are more than there is memory for.

        Of the keyframe to be added those bricks count that are near its own surfaces.
        """
        own = len(added.surface) * self._bytes_per_brick
        what = f"a map of {len(self._shares) + 1} keyframes with their messages"
        if self._pool.memory_limit_gb > 0:
            voxels = len(self._pool.in_use) * VOXELS * self._pool.bytes_per_voxel
            wanted = voxels + self._images + image_bytes + self._messages + own
            check_memory(wanted, what, self._pool.memory_limit_gb)
        check_memory(self._to_come + own, what)

    def take(self, keyframe: Keyframe) -> None:
        """Count a keyframe that has no messages yet."""
        share = _Share(len(keyframe.visible.slots) * self._bytes_per_brick, keyframe.image_bytes)
        self._shares[keyframe.id] = share
        self._messages, self._images = self._messages + share.messages, self._images + share.image
        self.mark_unallocated(keyframe.id)

    def has_spoken(self, id: int) -> None:
        """Note that the memory for a keyframe's messages has been taken."""
        if id in self._silent:
            self._silent.remove(id)
            self._to_come -= self._shares[id].messages

    def mark_unallocated(self, id: int) -> None:
        """Note that a keyframe has no messages, and will want them."""
        if id not in self._silent:
            self._silent.add(id)
            self._to_come += self._shares[id].messages

    def give_back(self, id: int) -> None:
        """Count a keyframe no more."""
        self.has_spoken(id)
        share = self._shares.pop(id)
        self._messages, self._images = self._messages - share.messages, self._images - share.image
