"""The state that an MRFMap returns to when a full inference is stopped before its end.

Full inference starts by dropping all messages. A caller that may have to stop it, to carry out an edit for
instance, takes a checkpoint first: the beliefs, which queries can keep reading (BrickPool.showing), and the
messages behind them. Between checkpoint and restore no keyframe may be added, removed or moved.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.pool import BrickPool, PoolSnapshot


@dataclass(frozen=True)
class Checkpoint:
    """A map's beliefs, and for each keyframe its visible bricks, its messages for them, and the bricks'
    change counts at its last sweep."""

    pool: PoolSnapshot
    messages: dict[int, "tuple[VisibleBricks, ti.Ndarray | None, NDArray[np.int64] | None]"]
    messages_lost: bool
    settled: bool


def take_checkpoint(
    pool: BrickPool, keyframes: Iterable[Keyframe], messages_lost: bool, settled: bool
) -> Checkpoint:
    """Copy the beliefs. The messages need no copy because full inference starts with new arrays."""
    return Checkpoint(
        pool.snapshot(),
        {k.id: (k.visible, k.messages, k.change_count_at_last_sweep) for k in keyframes},
        messages_lost,
        settled,
    )


def go_back(checkpoint: Checkpoint, pool: BrickPool, keyframes: Iterable[Keyframe]) -> None:
    """Restore beliefs and messages as of the checkpoint."""
    pool.restore(checkpoint.pool)
    for keyframe in keyframes:
        keyframe.visible, keyframe.messages, keyframe.change_count_at_last_sweep = checkpoint.messages[
            keyframe.id
        ]
        keyframe.pending_visible = None
