"""Whether there is room for the keyframes of a map: asked as each is added, so that inference, which takes
most of the memory, does not end for the lack of it what took hours.
"""

from collections.abc import Collection

from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.memory import check_memory
from taichi_mrf.voxels.pool import BrickPool


def check_room(keyframes: Collection[Keyframe], pool: BrickPool, precision: str) -> None:
    """Raise CapacityError if the map with all these keyframes, each with its messages, is over the pool's
    limit, or if the messages that are still to come are more than there is memory for.

    The bricks that a keyframe sees are those at the time when it was added: later ones only add a little.
    """
    bytes_per_brick = VOXELS * (2 if precision == "float16" else 4)
    sizes = [(k.image_bytes, len(k.visible.slots) * bytes_per_brick, k.messages is None) for k in keyframes]
    to_come = sum(messages for _, messages, are_to_come in sizes if are_to_come)
    what = f"a map of {len(sizes)} keyframes with their messages"
    if pool.memory_limit_gb > 0:
        voxels = len(pool.in_use) * VOXELS * pool.bytes_per_voxel
        check_memory(voxels + sum(a + b for a, b, _ in sizes), what, pool.memory_limit_gb)
    check_memory(to_come, what)
