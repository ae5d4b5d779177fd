"""What an MRFMap goes back to when a full inference is given up before its end.

Full inference forgets all messages first. Whoever may want to break it off, because an edit has come, keeps
a checkpoint: the beliefs as they were (which queries can go on reading, see BrickPool.showing) and the
messages behind them. Between the two no keyframe may come, go or move.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.voxels.pool import BrickPool, PoolSnapshot


@dataclass(frozen=True)
class Checkpoint:
    """A map's beliefs, and each keyframe's messages with the list of bricks that they are for, and what
    it had heard."""

    pool: PoolSnapshot
    messages: dict[int, "tuple[VisibleBricks, ti.Ndarray | None, NDArray[np.int64] | None]"]
    messages_lost: bool
    settled: bool


def take_checkpoint(
    pool: BrickPool, keyframes: Iterable[Keyframe], messages_lost: bool, settled: bool
) -> Checkpoint:
    """Copy the beliefs. The messages need no copy: full inference begins with new arrays."""
    return Checkpoint(
        pool.snapshot(),
        {k.id: (k.visible, k.messages, k.change_count_at_last_sweep) for k in keyframes},
        messages_lost,
        settled,
    )


def go_back(checkpoint: Checkpoint, pool: BrickPool, keyframes: Iterable[Keyframe]) -> None:
    """Undo all sweeps since the checkpoint."""
    pool.restore(checkpoint.pool)
    for keyframe in keyframes:
        keyframe.visible, keyframe.messages, keyframe.change_count_at_last_sweep = checkpoint.messages[
            keyframe.id
        ]
        keyframe.pending_visible = None
