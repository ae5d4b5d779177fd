"""Which of the map's bricks a keyframe sees now: its footprint, matched with the bricks that exist."""

import numpy as np
import taichi as ti

from taichi_mrf.inference.keyframe import Footprint, VisibleBricks
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology
from taichi_mrf.voxels.types import AnyArray, I32Array


def find_visible(footprint: Footprint, topology: Topology, pool: BrickPool, version: int) -> VisibleBricks:
    """The bricks that exist among those that a keyframe's rays cross."""
    slots = topology.slots(footprint.window.bricks_of(footprint.crossed))
    exist = slots >= 0
    slots = slots[exist]
    return VisibleBricks(footprint.crossed[exist], slots, pool.identity[slots], version)


def new_messages(
    visible: VisibleBricks, precision: str, old: VisibleBricks, old_messages: "ti.Ndarray | None"
) -> "ti.Ndarray":
    """Messages for a list of bricks: kept where the same brick was on the old list, else none (0)."""
    messages = ti.ndarray(ti.f16 if precision == "float16" else ti.f32, max(1, len(visible.cells)) * VOXELS)
    messages.fill(0)
    if old_messages is None or len(old.cells) == 0 or len(visible.cells) == 0:
        return messages
    place = np.minimum(np.searchsorted(old.cells, visible.cells), len(old.cells) - 1)
    same = (old.cells[place] == visible.cells) & (old.identity[place] == visible.identity)
    _carry_over(np.where(same, place, -1).astype(np.int32), old_messages, messages)
    return messages


@ti.kernel
def _carry_over(place: I32Array, old: AnyArray, new: AnyArray):
    for i in range(place.shape[0] * VOXELS):
        if place[i // VOXELS] >= 0:
            new[i] = old[place[i // VOXELS] * VOXELS + i % VOXELS]
