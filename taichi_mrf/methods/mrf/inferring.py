"""Inference in an MRFMap: which keyframes are swept, from which messages, and how a stopped run is undone.

Full inference starts by dropping all messages. A caller that may have to stop it, to carry out an edit for
instance, takes a checkpoint first: the beliefs, which queries can keep reading (showing), and the messages
behind them. Between checkpoint and return no keyframe may be added, removed or moved.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.schedule import InferSteps, content_key, driven, sweep_steps
from taichi_mrf.methods.brick_map import check_inference
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.system.later import later
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import PoolSnapshot

if TYPE_CHECKING:
    from taichi_mrf.methods.mrf import surfacing
else:
    (surfacing,) = later("taichi_mrf.methods.mrf", "surfacing")


OF_MESSAGES = ("messages", "visible", "pending_visible", "change_count_at_last_sweep")
"""Attributes of a keyframe that go with its messages."""


@dataclass(frozen=True)
class Checkpoint:
    """A map's beliefs, and for each keyframe what belongs to its messages (``OF_MESSAGES``). With the beliefs
    it keeps a state that was, whole: for queries to read (:func:`showing`) and to go back to."""

    pool: PoolSnapshot
    messages: dict[int, dict[str, Any]]
    messages_lost: bool
    settled: bool


def infer_steps(
    parts: MapParts,
    sweeps: int | None = None,
    tolerance: float | None = None,
    keyframes: Iterable[int] | None = None,
) -> InferSteps:
    """MRFMap.infer_steps."""
    chosen_ids = check_inference(sweeps, tolerance, keyframes)
    configured = parts.config.inference.sweeps
    sweeps, tolerance = configured if sweeps is None else sweeps, tolerance or 0.0
    pool, dated = parts.pool, parts.dated
    if chosen_ids is None:
        chosen = sorted(parts.keyframes.values(), key=content_key)
        pool.restart()
        for keyframe in chosen:
            keyframe.messages = None
            parts.allocator.refresh(keyframe)
        parts.messages_lost = False
    else:
        chosen = [parts.find(id) for id in chosen_ids]
        restore_messages(parts)
        for keyframe in chosen:
            parts.allocator.refresh(keyframe)
    for keyframe in chosen:
        pool.touch(keyframe.visible.slots)
    as_configured = chosen_ids is None and (sweeps, tolerance) == (configured, 0.0)
    complete = False
    try:
        note = None if dated is None or chosen_ids is None else dated.note_sweep
        report = yield from sweep_steps(chosen, pool, parts.sweeper, sweeps, tolerance, note)
        complete = report.complete
    finally:
        parts.settled = complete and as_configured
        if dated is not None and chosen_ids is None:
            dated.outdate()
    return report


def restore_messages(parts: MapParts) -> None:
    """Compute the messages of a loaded map: its file holds none, because they follow from the images."""
    if parts.messages_lost:
        driven(infer_steps(parts), None)


def freeze_keyframe(parts: MapParts, id: int) -> None:
    """MRFMap.freeze_keyframe."""
    keyframe = parts.find(id)
    restore_messages(parts)
    if keyframe.messages is None:
        raise KeyframeError(f"keyframe {id} ({keyframe.name}) has no messages to freeze: call infer first")
    for layer in parts.layers.values():
        layer.freeze(keyframe)
    surfacing.keep_rays(parts, keyframe)
    parts.allocator.freeze(keyframe)
    parts.surfels.freeze(keyframe)
    parts.decisions.frozen(id)
    parts.frozen[id] = keyframe.name
    drop(parts, id)


def drop(parts: MapParts, id: int) -> None:
    """Forget a keyframe that was taken out or frozen. Frozen ones may have waited for it."""
    del parts.keyframes[id]
    parts.settled = False
    if parts.dated is not None:
        parts.dated.fold_for_good()


def show(parts: MapParts, slots: NDArray[np.int32], log_odds: NDArray[np.float32]) -> None:
    """Let queries read these log-odds, (n) -> (n, 512), until the next inference."""
    parts.pool.write("total", slots, log_odds)
    if parts.dated is not None:
        parts.dated.show(slots, log_odds, parts.dated.now_s)


def adopt(parts: MapParts, log_odds: NDArray[np.float32]) -> None:
    """MRFMap.adopt."""
    parts.pool.restart()
    for keyframe in parts.keyframes.values():
        keyframe.messages = None
    parts.allocator.mark_without_messages(parts.keyframes.values())
    show(parts, parts.pool.in_use, log_odds.reshape(-1, VOXELS).astype(np.float32))
    parts.messages_lost, parts.settled = bool(parts.keyframes), False


def take_checkpoint(parts: MapParts) -> Checkpoint:
    """Copy the beliefs. The messages need no copy because full inference starts with new arrays."""
    return Checkpoint(
        parts.pool.snapshot(),
        {k.id: {name: getattr(k, name) for name in OF_MESSAGES} for k in parts.keyframes.values()},
        parts.messages_lost,
        parts.settled,
    )


@contextmanager
def showing(parts: MapParts, checkpoint: Checkpoint) -> Iterator[None]:
    """MRFMap.showing: beliefs and messages are those of the checkpoint while the block runs."""
    names = (*OF_MESSAGES, "revision")
    keyframes, settled = list(parts.keyframes.values()), parts.settled
    now = [{name: getattr(keyframe, name) for name in names} for keyframe in keyframes]
    try:
        with parts.pool.showing(checkpoint.pool):
            parts.settled = checkpoint.settled
            for keyframe in keyframes:
                _give_back(keyframe, checkpoint)
            yield
    finally:
        parts.settled = settled
        for keyframe, values in zip(keyframes, now, strict=True):
            for name, value in values.items():
                setattr(keyframe, name, value)


def _give_back(keyframe: Keyframe, checkpoint: Checkpoint) -> None:
    """Give a keyframe its messages as of a checkpoint."""
    for name, value in checkpoint.messages[keyframe.id].items():
        setattr(keyframe, name, value)


def go_back(parts: MapParts, checkpoint: Checkpoint) -> None:
    """Restore beliefs and messages as of the checkpoint."""
    parts.pool.restore(checkpoint.pool)
    for keyframe in parts.keyframes.values():
        _give_back(keyframe, checkpoint)
    parts.messages_lost, parts.settled = checkpoint.messages_lost, checkpoint.settled
    parts.allocator.mark_without_messages(parts.keyframes.values())
    if parts.dated is not None:
        parts.dated.outdate()
