"""Keyframes' messages: kept in step with the bricks that they see, and counted."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference import leave
from taichi_mrf.inference.keyframe import VisibleBricks
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, AnyArray, F32Array, I32Array, Template
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.numbering import strip_begin, strip_length
from taichi_mrf.voxels.pool import BrickPool


def new_messages(visible: VisibleBricks, precision: str) -> "ti.Ndarray":
    """(bricks * 512) messages of log-odds 0, in float16 or float32."""
    messages = ti.ndarray(ti.f16 if precision == "float16" else ti.f32, max(1, len(visible.cells)) * VOXELS)
    _clear(messages, strip_length())
    return messages


def carry_over(
    old: VisibleBricks, old_messages: "ti.Ndarray", visible: VisibleBricks, messages: "ti.Ndarray"
) -> None:
    """Copy the messages to those bricks that were on the old list and are still the same."""
    place = places_of(old, visible)
    if (place >= 0).any():
        _copy_bricks(place, old_messages, messages, strip_length())
    runtime.settle()  # before the old ones are dropped


def withdraw_messages(
    visible: VisibleBricks, messages: "ti.Ndarray", belief: "ti.Ndarray"
) -> NDArray[np.int32]:
    """Take a keyframe's messages out of the beliefs, those of the map or of a snapshot; returns how many
    voxels of each visible brick that moved, (n,)."""
    n = len(visible.slots)
    if n == 0:
        return np.zeros(0, np.int32)
    moved = np.zeros(n, np.int32)
    leave.withdraw(visible.slots, belief, messages, moved, strip_length())
    return moved


def places_of(old: VisibleBricks, visible: VisibleBricks) -> NDArray[np.int32]:
    """Index of each brick of a list (n) on an older list of the same keyframe; -1 for one that was not on it,
    or was another brick."""
    if len(old.cells) == 0:
        return np.full(len(visible.cells), -1, np.int32)
    place = np.minimum(np.searchsorted(old.cells, visible.cells), len(old.cells) - 1)
    same = (old.cells[place] == visible.cells) & (old.identity[place] == visible.identity)
    return np.where(same, place, -1).astype(np.int32)


def count_observations(
    slots: NDArray[np.int32], keyframes: Iterable[tuple[VisibleBricks, "ti.Ndarray"]], pool: BrickPool
) -> NDArray[np.uint8]:
    """Number of keyframes with a message to each voxel of some bricks, (n,) -> (n, 512); 255 is "or more".

    ``keyframes`` are their lists of bricks with their messages. All frozen keyframes count as one.
    """
    if len(slots) == 0:
        return np.zeros((0, VOXELS), np.uint8)
    row_of = np.full(pool.capacity, -1, np.int32)
    row_of[slots] = np.arange(len(slots))
    counts = ti.ndarray(ti.i32, len(slots) * VOXELS)
    for visible, messages in keyframes:
        rows = row_of[visible.slots]
        rows[pool.identity[visible.slots] != visible.identity] = -1  # the slot has changed hands
        places = np.flatnonzero(rows >= 0).astype(np.int32)
        if len(places):
            _count_messages(places, np.ascontiguousarray(rows[places]), messages, counts, strip_length())
    if pool.evidence is not None:
        _count_evidence(slots, pool.evidence, pool.prior_log_odds, counts, strip_length())
    result = np.minimum(counts.to_numpy(), 255).astype(np.uint8).reshape(-1, VOXELS)
    runtime.settle()  # before the counts are dropped
    return result


def messages_at(
    slot: int,
    voxel: int,
    keyframes: Iterable[tuple[int, VisibleBricks, "ti.Ndarray"]],
    pool: BrickPool,
) -> dict[int, float]:
    """Messages of keyframes, given as their ids, lists of bricks and messages, to one voxel of the brick in a
    slot of the pool, by id. Those that send none are left out."""
    found = {}
    for id, visible, messages in keyframes:
        here = (visible.slots == slot) & (visible.identity == pool.identity[slot])
        for place in np.flatnonzero(here).tolist():
            found[id] = float(messages[place * VOXELS + voxel])
    return {id: message for id, message in found.items() if message != 0}


@ti.kernel
def _count_messages(
    places: I32Array, rows: I32Array, messages: AnyArray, counts: I32Array, strip: Template
):  # fmt: skip
    """Add 1 to the ``counts`` (rows * 512) of voxels to which a keyframe sends a message.

    ``places`` (n) are bricks of its ``messages`` (bricks * 512), ``rows`` (n) their rows in the counts.
    """
    for part in range(places.shape[0] * (VOXELS // strip)):
        _, source = strip_begin(part, places, strip)
        _, target = strip_begin(part, rows, strip)
        for k in range(strip):
            counts[target + k] += ti.cast(messages[source + k] != 0, ti.i32)


@ti.kernel
def _count_evidence(slots: I32Array, evidence: F32Array, prior: F32, counts: I32Array, strip: Template):
    """Add 1 to the ``counts`` (n * 512) of voxels of the bricks in ``slots`` (n) whose ``evidence`` (pool *
    512) is not the ``prior`` log-odds."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            counts[i + k] += ti.cast(evidence[j + k] != prior, ti.i32)


@ti.kernel
def _clear(messages: AnyArray, strip: Template):
    """Set messages (bricks * 512) to 0."""
    for part in range(messages.shape[0] // strip):
        for k in range(strip):
            messages[part * strip + k] = 0.0


@ti.kernel
def _copy_bricks(place: I32Array, old: AnyArray, new: AnyArray, strip: Template):
    """Copy messages of bricks: brick i of ``new`` (n * 512) from brick ``place[i]`` (n) of ``old``, -1 for
    none."""
    for part in range(place.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, place, strip)
        if place[i // VOXELS] >= 0:
            for k in range(strip):
                new[i + k] = old[j + k]
