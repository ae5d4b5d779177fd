"""The arrays of dated beliefs (dated.py), and the kernels that let time pass in them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array, I32Array, Template
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.log_odds import faded
from taichi_mrf.voxels.numbering import strip_begin
from taichi_mrf.voxels.pool import grown

SURELY_FREE = 4.0
"""Log-odds below the prior from which a voxel counts as surely free, so that a view against it is a
glimpse."""

NEVER = -np.inf


@dataclass(frozen=True)
class Aging(Bundle):
    """Effect of time on some bricks, (n) each."""

    kept: F32Array
    """Chance that the state is that of then."""

    left: F32Array
    """Chance that what is free now was occupied then."""

    appeared: F32Array
    """Chance that what is occupied now was free then."""

    lasting: F32Array
    """Share of a glimpse that is left."""


@dataclass
class Channels:
    """Dated beliefs of a pool's voxels, (capacity * 512) log-odds each: ``now`` without glimpses, ``shown``
    with them. ``glimpsed`` (capacity) counts the voxels of each brick in which they differ, and ``stamp_s``
    (capacity) is the time that a brick's beliefs are for, in seconds; NEVER before any keyframe."""

    now: ti.Ndarray
    shown: ti.Ndarray
    glimpsed: ti.Ndarray
    stamp_s: NDArray[np.float64]

    @staticmethod
    def at_prior(capacity: int, prior_log_odds: float) -> "Channels":
        """Beliefs of bricks of which nothing is known."""
        bricks = max(1, capacity)
        now, shown = ti.ndarray(ti.f32, bricks * VOXELS), ti.ndarray(ti.f32, bricks * VOXELS)
        glimpsed = ti.ndarray(ti.i32, bricks)
        now.fill(prior_log_odds)
        shown.fill(prior_log_odds)
        glimpsed.fill(0)
        return Channels(now, shown, glimpsed, np.full(bricks, NEVER))


def grown_channels(old: Channels, old_capacity: int, capacity: int) -> Channels:
    counts = ti.ndarray(ti.i32, capacity)
    kept = np.zeros(capacity, np.int32)
    kept[:old_capacity] = old.glimpsed.to_numpy()[:old_capacity]
    counts.from_numpy(kept)
    stamps = np.full(capacity, NEVER)
    stamps[:old_capacity] = old.stamp_s[:old_capacity]
    now, shown = (grown(channel, old_capacity, capacity) for channel in (old.now, old.shown))
    return Channels(now, shown, counts, stamps)


@ti.func
def past(now: F32, shown: F32, prior: F32, aging: Template, brick: I32):
    """Present worth of a voxel's past: evidence, as log-odds over the prior, and a glimpse beyond that."""
    evidence = now - prior
    if evidence != 0.0:
        evidence = faded(evidence, aging.kept[brick], aging.left[brick], aging.appeared[brick])
    return evidence, (shown - now) * aging.lasting[brick]


@kernel
def fold_bricks(
    places: I32Array, slots: I32Array, now: F32Array, shown: F32Array, glimpsed: I32Array,
    messages: AnyArray, aging: Aging, prior: F32, strip: Template,
) -> None:  # fmt: skip
    """Age bricks and add a keyframe's messages to them.

    ``places`` (n) are bricks of its ``messages`` (bricks * 512), ``slots`` (n) their places in the pool;
    the others are those of Channels.
    """
    for part in range(places.shape[0] * (VOXELS // strip)):
        i, target = strip_begin(part, slots, strip)
        _, source = strip_begin(part, places, strip)
        brick = i // VOXELS
        before = after = 0
        for k in range(strip):
            before += ti.cast(shown[target + k] > now[target + k], ti.i32)
            message = ti.cast(messages[source + k], ti.f32)
            evidence, glimpse = past(now[target + k], shown[target + k], prior, aging, brick)
            if message != 0.0:
                glimpse = glimpse_of(evidence, message, prior)
            now[target + k] = prior + evidence + message
            shown[target + k] = now[target + k] + glimpse
            after += ti.cast(shown[target + k] > now[target + k], ti.i32)
        if before != after:
            glimpsed[slots[brick]] += after - before


@ti.func
def glimpse_of(evidence: F32, message: F32, prior: F32) -> F32:
    """Addition to a voxel's log-odds that makes them what one view alone gives: above 0 if that view makes it
    occupied, and it was surely free before (``evidence``, log-odds over the prior)."""
    glimpse = 0.0
    if prior + message > 0.0 and evidence < -SURELY_FREE:
        glimpse = -evidence
    return glimpse


@kernel
def age_bricks(
    slots: I32Array, now: F32Array, shown: F32Array, glimpsed: I32Array, aging: Aging, prior: F32,
    strip: Template,
) -> None:  # fmt: skip
    """Let time pass in bricks; arrays as in :func:`fold_bricks`."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, target = strip_begin(part, slots, strip)
        brick = i // VOXELS
        before = after = 0
        for k in range(strip):
            before += ti.cast(shown[target + k] > now[target + k], ti.i32)
            evidence, glimpse = past(now[target + k], shown[target + k], prior, aging, brick)
            now[target + k] = prior + evidence
            shown[target + k] = now[target + k] + glimpse
            after += ti.cast(shown[target + k] > now[target + k], ti.i32)
        if before != after:
            glimpsed[slots[brick]] += after - before


@ti.kernel
def add_bricks(slots: I32Array, older: F32Array, now: F32Array, shown: F32Array, prior: F32, strip: Template):
    """Add the evidence of one channel (capacity * 512), log-odds over the prior, to bricks (n)."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, j = strip_begin(part, slots, strip)
        for k in range(strip):
            evidence = older[j + k] - prior
            if evidence != 0.0:
                glimpse = shown[j + k] - now[j + k]
                now[j + k] += evidence
                shown[j + k] = now[j + k] + glimpse


@ti.kernel
def copy_bricks(slots: I32Array, source: F32Array, target: F32Array, strip: Template):
    """Copy the bricks in ``slots`` (n) of one channel (capacity * 512) to another."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, j = strip_begin(part, slots, strip)
        for k in range(strip):
            target[j + k] = source[j + k]


@ti.kernel
def copy_counts(slots: I32Array, source: I32Array, target: I32Array):
    """Copy the counts (capacity) of some bricks (n)."""
    for i in range(slots.shape[0]):
        target[slots[i]] = source[slots[i]]


@ti.kernel
def clear_counts(counts: I32Array, slots: I32Array):
    """Set the ``counts`` (capacity) of some bricks (n) to zero."""
    for i in range(slots.shape[0]):
        counts[slots[i]] = 0
