"""A keyframe's messages, kept in step with the bricks that it sees."""

import numpy as np
import taichi as ti

from taichi_mrf import runtime
from taichi_mrf.inference.keyframe import VisibleBricks
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.types import AnyArray, I32Array


def new_messages(visible: VisibleBricks, precision: str) -> "ti.Ndarray":
    """(bricks * 512) messages that say nothing yet (log-odds 0), in float16 or float32."""
    messages = ti.ndarray(ti.f16 if precision == "float16" else ti.f32, max(1, len(visible.cells)) * VOXELS)
    messages.fill(0)
    return messages


def carry_over(
    old: VisibleBricks, old_messages: "ti.Ndarray", visible: VisibleBricks, messages: "ti.Ndarray"
) -> None:
    """Copy the messages to those bricks that were on the old list and are still the same."""
    if len(old.cells) == 0 or len(visible.cells) == 0:
        return
    place = np.minimum(np.searchsorted(old.cells, visible.cells), len(old.cells) - 1)
    same = (old.cells[place] == visible.cells) & (old.identity[place] == visible.identity)
    _copy_bricks(np.where(same, place, -1).astype(np.int32), old_messages, messages)
    runtime.settle()  # before the old ones are dropped


@ti.kernel
def _copy_bricks(place: I32Array, old: AnyArray, new: AnyArray):
    for i in range(place.shape[0] * VOXELS):
        if place[i // VOXELS] >= 0:
            new[i] = old[place[i // VOXELS] * VOXELS + i % VOXELS]
