"""Whether there is room for the keyframes of a map: asked as each is added, so that inference, which takes
most of the memory, does not end for the lack of it what took hours.
"""

from collections.abc import Collection

from taichi_mrf.inference.keyframe import Footprint, Keyframe
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.memory import check_memory
from taichi_mrf.voxels.pool import BrickPool


def check_room(
    others: Collection[Keyframe], added: Footprint, image_bytes: int, pool: BrickPool, precision: str
) -> None:
    """Raise CapacityError if the map with one more keyframe, all of them with their messages, is over the
    pool's limit, or if the messages that are still to come are more than there is memory for.

    A keyframe's bricks are those that it saw when it was added, and of the one to be added those near its own
    surfaces: what comes later in its view adds a little.
    """
    bytes_per_brick = VOXELS * (2 if precision == "float16" else 4)
    sizes = [(len(k.visible.slots) * bytes_per_brick, k.messages is None) for k in others]
    sizes.append((len(added.surface) * bytes_per_brick, True))
    what = f"a map of {len(sizes)} keyframes with their messages"
    if pool.memory_limit_gb > 0:
        voxels = len(pool.in_use) * VOXELS * pool.bytes_per_voxel
        images = image_bytes + sum(k.image_bytes for k in others)
        check_memory(voxels + images + sum(size for size, _ in sizes), what, pool.memory_limit_gb)
    check_memory(sum(size for size, is_to_come in sizes if is_to_come), what)
