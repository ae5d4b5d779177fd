"""Evidence with a date: what the keyframes' messages say of the present, if the world may change.

Each voxel is a two-state Markov chain in time (TimeConfig). Let L be the evidence for occupied, as log-odds
over the prior, of all keyframes up to some time. A time dt later it is worth

    L' = log( ((1 - a) e^L + a) / ((1 - l) + l e^L) )        a = (1 - s) g,  l = s g,  g = 1 - exp(-2 r dt)

where r is the flip rate, s the share of space that moving things fill, a the chance that what is occupied now
was free then, and l the chance that what is free now was occupied then. The next keyframe's message is added
to that. Time acts on the sum so far and not on each message, so 30 old views do not outvote 3 new ones: the
sum of any number of them is worth no more than -log l for occupied and log a for free.

Messages themselves do not depend on time: their cavities (eq. 6) come from all other keyframes.

What a single view sees in a place that was surely free cannot outweigh the past at once. So that someone who
walks past is not overlooked, queries read such a voxel as that view alone would have it (a glimpse), until
another view sees the voxel, or a few seconds are over.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.config.time import TimeConfig
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.schedule import content_key
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.log_odds import faded
from taichi_mrf.kernels.types import F32, AnyArray, F32Array, I32Array, Template
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool, fill_bricks, grown, read_bricks, write_bricks
from taichi_mrf.voxels.strips import strip_begin, strip_length

SURELY_FREE = 4.0
"""Log-odds below the prior from which a voxel counts as surely free, so that a view against it is a
glimpse."""

STEPS_A_HALF_LIFE = 64
"""Bricks that are not seen are brought up to date in so many steps for each half-life."""

FORGOTTEN = 1e-3
"""A glimpse of which less than this share is left is over."""

NEVER = -np.inf


@dataclass(frozen=True)
class Aging(Bundle):
    """What time does to some bricks, (n) each."""

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


class DatedBelief:
    """The beliefs that queries of a dated map read. They follow the messages when they are next read."""

    def __init__(
        self, pool: BrickPool, time: TimeConfig, keyframes: Callable[[], Iterable[Keyframe]]
    ) -> None:
        """``keyframes`` gives those that are not frozen."""
        self.pool, self.time, self._keyframes = pool, time, keyframes
        self._channels = Channels.at_prior(pool.capacity, pool.prior_log_odds)
        self._outdated = np.zeros(len(self._channels.stamp_s), bool)
        self.frozen: Channels | None = None

    @property
    def bytes_per_voxel(self) -> int:
        """Bytes of the channels for each voxel."""
        return 8 if self.frozen is None else 16

    @property
    def now_s(self) -> float:
        """The newest keyframe's stamp, in seconds; NEVER if there is none."""
        stamps = [keyframe.stamp_s for keyframe in self._keyframes()]
        if self.frozen is not None:
            stamps.append(float(self.frozen.stamp_s.max()))
        return max(stamps, default=NEVER)

    def current(self) -> "ti.Ndarray":
        """The log-odds of all voxels (capacity * 512), as of the newest keyframe."""
        now_s = self.now_s
        self._outdated |= self._channels.stamp_s > now_s  # the newest keyframe has gone
        slots = np.flatnonzero(self._outdated[: self.pool.capacity] & (self.pool.owners > 0))
        if len(slots):
            self._fold_anew(self._channels, slots.astype(np.int32), np.inf)
            self._outdated[:] = False
        self._advance(self._channels, now_s)
        return self._channels.shown

    def as_of(self, stamp_s: float) -> "ti.Ndarray":
        """The log-odds of all voxels as of a time, from the keyframes up to then."""
        channels = Channels.at_prior(self.pool.capacity, self.pool.prior_log_odds)
        slots = self.pool.in_use
        if len(slots):
            self._fold_anew(channels, slots, stamp_s)
            seen = slots[np.isfinite(channels.stamp_s[slots])]
            self._age(channels, seen, np.full(len(seen), stamp_s))
        return channels.shown

    def outdate(self, slots: NDArray[np.int32] | None = None) -> None:
        """Messages to these bricks have changed; None for all."""
        self._outdated[slice(None) if slots is None else slots] = True

    def note_sweep(self, keyframe: Keyframe, moved: NDArray[np.int32], first: bool) -> None:
        """A sweep has renewed a keyframe's messages, or has computed the ``first``; ``moved`` (n) counts the
        marginals that it has moved in each visible brick."""
        slots = keyframe.visible.slots
        if not first:
            self.outdate(slots[moved > 0])
            return
        channels = self._channels
        newest = ~self._outdated[slots] & (channels.stamp_s[slots] <= keyframe.stamp_s)
        self.outdate(slots[~newest])
        self._fold(channels, keyframe, np.flatnonzero(newest))

    def freeze(self, keyframe: Keyframe) -> None:
        """Add a keyframe's messages to what is known for good, as of its stamp."""
        if self.frozen is None:
            self.frozen = Channels.at_prior(self.pool.capacity, self.pool.prior_log_odds)
        self._fold(self.frozen, keyframe, np.arange(len(keyframe.visible.slots)))
        self.outdate(keyframe.visible.slots)

    def show(self, slots: NDArray[np.int32], belief: NDArray[np.float32], stamp_s: float) -> None:
        """Read these log-odds, (n) -> (n, 512), as of a time until messages change."""
        flat = np.ascontiguousarray(belief, np.float32).reshape(-1)
        for channel in (self._channels.now, self._channels.shown):
            write_bricks(channel, slots, flat, strip_length())
        self._channels.stamp_s[slots] = stamp_s
        self._outdated[slots] = False

    def restore_frozen(
        self, slots: NDArray[np.int32], belief: NDArray[np.float32], stamps_s: NDArray[np.float64]
    ) -> None:
        """What frozen keyframes say of some bricks, (n, 512) log-odds as of (n) stamps: from a file."""
        if self.frozen is None:
            self.frozen = Channels.at_prior(self.pool.capacity, self.pool.prior_log_odds)
        flat = np.ascontiguousarray(belief, np.float32).reshape(-1)
        for channel in (self.frozen.now, self.frozen.shown):
            write_bricks(channel, slots, flat, strip_length())
        self.frozen.stamp_s[slots] = stamps_s
        self.outdate(slots)

    def read_frozen(self, slots: NDArray[np.int32]) -> tuple[NDArray[np.float32], NDArray[np.float64]] | None:
        """The same, to save it; None if nothing is frozen."""
        if self.frozen is None:
            return None
        out = np.zeros(len(slots) * VOXELS, np.float32)
        if len(slots):
            read_bricks(self.frozen.now, slots, out, strip_length())
        return out.reshape(-1, VOXELS), self.frozen.stamp_s[slots]

    def start(self, slots: NDArray[np.int32]) -> None:
        """New bricks, (n) slots: their voxels are at the prior."""
        for channels in (self._channels, self.frozen):
            if channels is not None:
                self._reset(channels, slots)
        self._outdated[slots] = False

    def grow(self, old_capacity: int, capacity: int) -> None:
        """Make room for ``capacity`` bricks."""
        self._channels = _grown_channels(self._channels, old_capacity, capacity)
        if self.frozen is not None:
            self.frozen = _grown_channels(self.frozen, old_capacity, capacity)
        more = np.zeros(capacity - old_capacity, bool)
        self._outdated = np.concatenate([self._outdated[:old_capacity], more])

    def _reset(self, channels: Channels, slots: NDArray[np.int32]) -> None:
        for channel in (channels.now, channels.shown):
            fill_bricks(channel, slots, self.pool.prior_log_odds, strip_length())
        _clear_counts(channels.glimpsed, slots)
        channels.stamp_s[slots] = NEVER

    def _fold_anew(self, channels: Channels, slots: NDArray[np.int32], until_s: float) -> None:
        """The beliefs of some bricks (n) from all messages of keyframes up to a time, in their order."""
        self._reset(channels, slots)
        wanted = np.zeros(self.pool.capacity, bool)
        wanted[slots] = True
        if self.frozen is not None:
            known = slots[self.frozen.stamp_s[slots] <= until_s]
            _copy_bricks(known, self.frozen.now, channels.now, strip_length())
            _copy_bricks(known, self.frozen.shown, channels.shown, strip_length())
            _copy_counts(known, self.frozen.glimpsed, channels.glimpsed)
            channels.stamp_s[known] = self.frozen.stamp_s[known]
        chosen = [k for k in self._keyframes() if k.messages is not None and k.stamp_s <= until_s]
        for keyframe in in_time(chosen):
            visible = keyframe.visible
            same = self.pool.identity[visible.slots] == visible.identity
            self._fold(channels, keyframe, np.flatnonzero(wanted[visible.slots] & same))

    def _fold(self, channels: Channels, keyframe: Keyframe, places: NDArray[np.intp]) -> None:
        """Let time pass up to a keyframe's stamp in some of its bricks, and add its messages to them."""
        if len(places) == 0:
            return
        slots = np.ascontiguousarray(keyframe.visible.slots[places])
        before = channels.stamp_s[slots]
        _fold_bricks(
            places.astype(np.int32), slots, channels.now, channels.shown, channels.glimpsed,
            keyframe.messages, self._aging(keyframe.stamp_s - before), self.pool.prior_log_odds,
            strip_length(),
        )  # fmt: skip
        channels.stamp_s[slots] = np.maximum(before, keyframe.stamp_s)
        runtime.settle()  # before the arrays of the call are dropped

    def _advance(self, channels: Channels, now_s: float) -> None:
        """Let time pass up to now: for bricks with glimpses at once, for all others in large steps."""
        slots = self.pool.in_use
        if len(slots) == 0 or not np.isfinite(now_s):
            return
        step = self.time.half_life_s / STEPS_A_HALF_LIFE
        glimpsed = channels.glimpsed.to_numpy()[slots] > 0
        target = np.where(glimpsed, now_s, np.floor(now_s / step) * step)
        stamps = channels.stamp_s[slots]
        late = np.isfinite(stamps) & (stamps < target)
        self._age(channels, slots[late], target[late])

    def _age(self, channels: Channels, slots: NDArray[np.int32], target_s: NDArray[np.float64]) -> None:
        """Let time pass in some bricks, up to a time for each, (n)."""
        if len(slots) == 0:
            return
        aging = self._aging(target_s - channels.stamp_s[slots])
        _age_bricks(
            slots, channels.now, channels.shown, channels.glimpsed, aging, self.pool.prior_log_odds,
            strip_length(),
        )  # fmt: skip
        channels.stamp_s[slots] = target_s
        self.pool.touch(slots)
        runtime.settle()  # before the arrays of the call are dropped

    def _aging(self, seconds: NDArray[np.float64]) -> Aging:
        """What some seconds do, (n); nothing where there are none, or nothing was known before."""
        seconds = np.where(np.isfinite(seconds), np.maximum(seconds, 0.0), 0.0)
        forgotten = -np.expm1(-2.0 * self.time.flip_rate * seconds)
        lasting = 0.5 ** (seconds / self.time.glimpse_half_life_s)
        lasting[lasting < FORGOTTEN] = 0.0
        share = self.time.moving_share
        parts = (share * forgotten, (1.0 - share) * forgotten, lasting)
        return Aging(*(part.astype(np.float32) for part in parts))


def in_time(keyframes: Iterable[Keyframe]) -> list[Keyframe]:
    """Keyframes by their stamps; those of one stamp by their content, so that the order does not depend on
    how they were added."""
    ordered: list[Keyframe] = []
    for _, group in groupby(sorted(keyframes, key=lambda k: k.stamp_s), key=lambda k: k.stamp_s):
        same = list(group)
        ordered += sorted(same, key=content_key) if len(same) > 1 else same
    return ordered


def layer_of(total: "ti.Ndarray", shown: "ti.Ndarray", prior_log_odds: float, dynamic: bool) -> "ti.Ndarray":
    """One layer of dated beliefs, (capacity * 512): the dynamic one, or the static one.

    A voxel is dynamic if it is occupied now, although all evidence together (``total``) makes it less likely
    than the prior. There the static layer reads the total, and everywhere else the dynamic one the prior.
    """
    out = ti.ndarray(ti.f32, shown.shape)
    _split(total, shown, out, prior_log_odds, dynamic)
    return out


def _grown_channels(old: Channels, old_capacity: int, capacity: int) -> Channels:
    counts = ti.ndarray(ti.i32, capacity)
    kept = np.zeros(capacity, np.int32)
    kept[:old_capacity] = old.glimpsed.to_numpy()[:old_capacity]
    counts.from_numpy(kept)
    stamps = np.full(capacity, NEVER)
    stamps[:old_capacity] = old.stamp_s[:old_capacity]
    now, shown = (grown(channel, old_capacity, capacity) for channel in (old.now, old.shown))
    return Channels(now, shown, counts, stamps)


@kernel
def _fold_bricks(
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
            glimpse = shown[target + k] - now[target + k]
            before += ti.cast(glimpse > 0.0, ti.i32)
            message = ti.cast(messages[source + k], ti.f32)
            evidence = faded(now[target + k] - prior, aging.left[brick], aging.appeared[brick])
            glimpse *= aging.lasting[brick]
            if message != 0.0:
                glimpse = glimpse_of(evidence, message, prior)
            after += ti.cast(glimpse > 0.0, ti.i32)
            now[target + k] = prior + evidence + message
            shown[target + k] = now[target + k] + glimpse
        if before != after:
            glimpsed[slots[brick]] += after - before


@ti.func
def glimpse_of(evidence: F32, message: F32, prior: F32) -> F32:
    """What is to be added to a voxel's log-odds so that they are what one view alone makes of it: above 0 if
    that makes it occupied, and it was surely free before (``evidence``, log-odds over the prior)."""
    glimpse = 0.0
    if prior + message > 0.0 and evidence < -SURELY_FREE:
        glimpse = -evidence
    return glimpse


@kernel
def _age_bricks(
    slots: I32Array, now: F32Array, shown: F32Array, glimpsed: I32Array, aging: Aging, prior: F32,
    strip: Template,
) -> None:  # fmt: skip
    """Let time pass in bricks; arrays as in :func:`_fold_bricks`."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, target = strip_begin(part, slots, strip)
        brick = i // VOXELS
        before = after = 0
        for k in range(strip):
            glimpse = shown[target + k] - now[target + k]
            before += ti.cast(glimpse > 0.0, ti.i32)
            glimpse *= aging.lasting[brick]
            after += ti.cast(glimpse > 0.0, ti.i32)
            evidence = faded(now[target + k] - prior, aging.left[brick], aging.appeared[brick])
            now[target + k] = prior + evidence
            shown[target + k] = now[target + k] + glimpse
        if before != after:
            glimpsed[slots[brick]] += after - before


@kernel
def _split(total: F32Array, shown: F32Array, out: F32Array, prior: F32, dynamic: Template) -> None:
    """See :func:`layer_of`; all arrays (capacity * 512)."""
    for i in range(shown.shape[0]):
        moving = shown[i] >= 0.0 and total[i] < prior
        if ti.static(dynamic):
            out[i] = shown[i] if moving else prior
        else:
            out[i] = total[i] if moving else shown[i]


@ti.kernel
def _copy_bricks(slots: I32Array, source: F32Array, target: F32Array, strip: Template):
    """Copy the bricks in ``slots`` (n) of one channel (capacity * 512) to another."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, j = strip_begin(part, slots, strip)
        for k in range(strip):
            target[j + k] = source[j + k]


@ti.kernel
def _copy_counts(slots: I32Array, source: I32Array, target: I32Array):
    """Copy the counts (capacity) of some bricks (n)."""
    for i in range(slots.shape[0]):
        target[slots[i]] = source[slots[i]]


@ti.kernel
def _clear_counts(counts: I32Array, slots: I32Array):
    """Set the ``counts`` (capacity) of some bricks (n) to zero."""
    for i in range(slots.shape[0]):
        counts[slots[i]] = 0
