"""Evidence with a date: what the keyframes' messages say of the present, if the world may change.

Each voxel is a two-state Markov chain in time (TimeConfig). Let L be the evidence for occupied, as log-odds
over the prior, of all keyframes up to some time. A time dt later it is worth

    L' = log( ((1 - a) e^L + a) / ((1 - l) + l e^L) )        a = (1 - s) g,  l = s g,  g = 1 - exp(-2 r dt)

where r is the flip rate, s the share of space that moving things fill, a the chance that what is occupied now
was free then, and l the chance that what is free now was occupied then. The next keyframe's message is added
to that. Time acts on the sum so far and not on each message, so 30 old views do not outvote 3 new ones: the
sum of any number of them is worth no more than -log l for occupied and log a for free.

What frozen keyframes say is folded for good, which has one order, too. So a keyframe that is frozen before an
older one leaves its messages, and they wait until no older one is to come. A keyframe that is added after
newer ones were folded for good is late: the late ones of a brick are folded by themselves, pass through time
up to what is there, and are added to it. They wait for each other.

Messages themselves do not depend on time: their cavities (eq. 6) come from all other keyframes.

What a single view sees in a place that was surely free cannot outweigh the past at once. So that someone who
walks past is not overlooked, queries read such a voxel as that view alone would have it (a glimpse), until
another view sees the voxel, or a few seconds are over.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.inference.dated_channels import (
    NEVER,
    Aging,
    Channels,
    add_bricks,
    age_bricks,
    clear_counts,
    copy_bricks,
    copy_counts,
    fold_bricks,
    grown_channels,
)
from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.inference.schedule import content_key
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.numbering import strip_length
from taichi_mrf.voxels.pool import BrickPool, fill_bricks, read_bricks, write_bricks

STEPS_A_HALF_LIFE = 64
"""Bricks that are not seen are brought up to date in so many steps for each half-life."""

FORGOTTEN = 1e-3
"""A glimpse of which less than this share is left is over."""

FEW_MOVED = 7
"""A brick is folded anew after a later sweep over a keyframe if more of its 512 marginals have moved by over
0.01. With 0 a keyframe costs 5% more, and beliefs are 0.0003 nearer to those of full inference."""


@dataclass
class Waiting:
    """The messages of a frozen keyframe that wait for older ones. ``content`` is its key among those of one
    stamp; ``left`` (n,) tells for which of its ``visible`` bricks."""

    stamp_s: float
    content: bytes
    visible: VisibleBricks
    messages: "ti.Ndarray"
    left: NDArray[np.bool_]

    @property
    def nbytes(self) -> int:
        """Bytes of the messages, which have two or four each."""
        return len(self.left) * VOXELS * (2 if self.messages.dtype == ti.f16 else 4)


class DatedBelief:
    """The beliefs that queries of a dated map read. They follow the messages when they are next read."""

    def __init__(
        self, pool: BrickPool, time: TimeConfig, keyframes: Callable[[], Iterable[Keyframe]]
    ) -> None:
        """``keyframes`` gives those that are not frozen."""
        self.pool, self.time, self._keyframes = pool, time, keyframes
        self._channels = Channels.at_prior(pool.capacity, pool.prior_log_odds)
        self._outdated = np.zeros(len(self._channels.stamp_s), bool)
        self._folded: set[int] = set()  # keyframes whose messages are in the beliefs, or are outdated there
        self.frozen: Channels | None = None
        self._waiting: list[Waiting] = []

    @property
    def waiting_bytes(self) -> int:
        """Bytes of the messages of frozen keyframes that wait for older ones."""
        return sum(each.nbytes for each in self._waiting)

    @property
    def bytes_per_voxel(self) -> int:
        """Bytes of the channels for each voxel."""
        return 8 if self.frozen is None else 16

    @property
    def now_s(self) -> float:
        """The newest keyframe's stamp, in seconds; NEVER if there is none."""
        stamps = [each.stamp_s for each in self._sources()]
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

    @property
    def frozen_s(self) -> float:
        """The stamp of the newest frozen keyframe, in seconds, as far as its bricks are in memory; -inf
        without one."""
        if self.frozen is None:
            return float("-inf")
        folded = float(self.frozen.stamp_s[self.pool.in_use].max(initial=-np.inf))
        return max(folded, *(each.stamp_s for each in self._waiting), folded)

    def outdate(self) -> None:
        """All messages may have changed."""
        self._outdated[:] = True
        self._folded = {keyframe.id for keyframe in self._keyframes() if keyframe.messages is not None}

    def withdraw(self, keyframe: Keyframe) -> None:
        """A keyframe goes, or is frozen: its messages no longer count."""
        self._outdated[keyframe.visible.slots] = True
        self._folded.discard(keyframe.id)

    def note_sweep(self, keyframe: Keyframe, moved: NDArray[np.int32]) -> None:
        """A sweep has computed a keyframe's messages; ``moved`` (n) counts the marginals that it has moved in
        each visible brick."""
        slots = keyframe.visible.slots
        if keyframe.id in self._folded:
            self._outdated[slots[moved > FEW_MOVED]] = True
            return
        self._folded.add(keyframe.id)
        channels = self._channels
        newest = ~self._outdated[slots] & (channels.stamp_s[slots] <= keyframe.stamp_s)
        self._outdated[slots[~newest]] = True
        self._fold(channels, keyframe, np.flatnonzero(newest))

    def freeze(self, keyframe: Keyframe) -> None:
        """Keep a keyframe's messages for :meth:`fold_for_good`, which is to be called once it is gone."""
        if self.frozen is None:
            self.frozen = Channels.at_prior(self.pool.capacity, self.pool.prior_log_odds)
        visible, messages = keyframe.visible, keyframe.messages
        left = np.ones(len(visible.slots), bool)
        self._waiting.append(Waiting(keyframe.stamp_s, content_key(keyframe), visible, messages, left))
        self.withdraw(keyframe)

    def fold_for_good(self, slots: NDArray[np.int32] | None = None) -> None:
        """Fold the messages of frozen keyframes for which no older one is to come; in some bricks, (n,)
        slots, of all that wait."""
        if not self._waiting or self.frozen is None:
            return
        ready = self._waiting
        if slots is None:
            live = list(self._keyframes())
            oldest_s = min((keyframe.stamp_s for keyframe in live), default=np.inf)
            if min(each.stamp_s for each in self._waiting) > oldest_s or self._any_late(live):
                return
            ready = []
            for each in in_time(self._sources()):
                if not isinstance(each, Waiting):
                    break
                ready.append(each)
        wanted = np.full(self.pool.capacity, slots is None)
        wanted[[] if slots is None else slots] = True
        self._fold_in_time(self.frozen, ready, wanted)
        for each in ready:
            each.left &= ~wanted[each.visible.slots] & self._same(each)
        self._waiting = [each for each in self._waiting if each.left.any()]

    def _any_late(self, keyframes: "Iterable[Keyframe]") -> bool:
        """True if newer messages than those of one of the keyframes were folded for good. Late ones are
        folded together, so that none is before all of them are frozen."""
        assert self.frozen is not None
        stamps_s = self.frozen.stamp_s
        return any((stamps_s[k.visible.slots[self._same(k)]] > k.stamp_s).any() for k in keyframes)

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
        """Restore what frozen keyframes say of some bricks: (n, 512) log-odds as of (n) stamps."""
        if self.frozen is None:
            self.frozen = Channels.at_prior(self.pool.capacity, self.pool.prior_log_odds)
        flat = np.ascontiguousarray(belief, np.float32).reshape(-1)
        for channel in (self.frozen.now, self.frozen.shown):
            write_bricks(channel, slots, flat, strip_length())
        self.frozen.stamp_s[slots] = stamps_s
        self._outdated[slots] = True

    def read_frozen(self, slots: NDArray[np.int32]) -> tuple[NDArray[np.float32], NDArray[np.float64]] | None:
        """Beliefs of frozen keyframes in some bricks and their stamps, to save them; None without any. Those
        that wait are not in them."""
        if self.frozen is None:
            return None
        out = np.zeros(len(slots) * VOXELS, np.float32)
        if len(slots):
            read_bricks(self.frozen.now, slots, out, strip_length())
        return out.reshape(-1, VOXELS), self.frozen.stamp_s[slots]

    def waiting(self) -> list[Waiting]:
        """The messages of frozen keyframes that wait for older ones, to save them, in the order of stamps."""
        return in_time(self._waiting)

    def wait(self, stamp_s: float, content: bytes, slots: NDArray[np.int32], messages: NDArray) -> None:
        """Restore messages (n, 512) that :meth:`waiting` had for the bricks in ``slots`` (n)."""
        on_device = ti.ndarray(ti.f16 if messages.dtype == np.float16 else ti.f32, messages.size)
        on_device.from_numpy(np.ascontiguousarray(messages).reshape(-1))
        visible = VisibleBricks(np.zeros(0, np.int32), slots, self.pool.identity[slots], -1)
        self._waiting.append(Waiting(stamp_s, content, visible, on_device, np.ones(len(slots), bool)))

    def start(self, slots: NDArray[np.int32]) -> None:
        """New bricks, (n) slots: their voxels are at the prior."""
        for channels in (self._channels, self.frozen):
            if channels is not None:
                self._reset(channels, slots)
        self._outdated[slots] = False

    def grow(self, old_capacity: int, capacity: int) -> None:
        """Make room for ``capacity`` bricks."""
        self._channels = grown_channels(self._channels, old_capacity, capacity)
        if self.frozen is not None:
            self.frozen = grown_channels(self.frozen, old_capacity, capacity)
        more = np.zeros(capacity - old_capacity, bool)
        self._outdated = np.concatenate([self._outdated[:old_capacity], more])

    def _reset(self, channels: Channels, slots: NDArray[np.int32]) -> None:
        for channel in (channels.now, channels.shown):
            fill_bricks(channel, slots, self.pool.prior_log_odds, strip_length())
        clear_counts(channels.glimpsed, slots)
        channels.stamp_s[slots] = NEVER

    def _fold_anew(self, channels: Channels, slots: NDArray[np.int32], until_s: float) -> None:
        """The beliefs of some bricks (n) from all messages of keyframes up to a time, in their order."""
        self._reset(channels, slots)
        wanted = np.zeros(self.pool.capacity, bool)
        wanted[slots] = True
        if self.frozen is not None:
            known = slots[self.frozen.stamp_s[slots] <= until_s]
            copy_bricks(known, self.frozen.now, channels.now, strip_length())
            copy_bricks(known, self.frozen.shown, channels.shown, strip_length())
            copy_counts(known, self.frozen.glimpsed, channels.glimpsed)
            channels.stamp_s[known] = self.frozen.stamp_s[known]
        chosen = [k for k in self._sources() if k.messages is not None and k.stamp_s <= until_s]
        self._fold_in_time(channels, chosen, wanted)

    def _sources(self) -> "list[Keyframe | Waiting]":
        """All whose messages are not folded for good."""
        sources: list[Keyframe | Waiting] = list(self._keyframes())
        return sources + self._waiting

    def _fold_in_time(
        self, channels: Channels, sources: Iterable["Keyframe | Waiting"], wanted: NDArray[np.bool_]
    ) -> None:
        """Add messages to the bricks that are ``wanted`` (capacity), in the order of their stamps; those that
        come too late for it by themselves."""
        older: Channels | None = None
        in_place: list[tuple[Keyframe | Waiting, NDArray[np.intp]]] = []
        for source in in_time(sources):
            places = np.flatnonzero(wanted[source.visible.slots] & self._same(source))
            late = channels.stamp_s[source.visible.slots[places]] > source.stamp_s
            in_place.append((source, places[~late]))
            if late.any():
                older = older or Channels.at_prior(self.pool.capacity, self.pool.prior_log_odds)
                self._fold(older, source, places[late])
        if older is not None:
            slots = np.flatnonzero(np.isfinite(older.stamp_s)).astype(np.int32)
            self._age(older, slots, channels.stamp_s[slots])
            add_bricks(
                slots, older.now, channels.now, channels.shown, self.pool.prior_log_odds, strip_length()
            )
        for source, places in in_place:
            self._fold(channels, source, places)

    def _same(self, source: "Keyframe | Waiting") -> NDArray[np.bool_]:
        """True for visible bricks that are still those of the messages, (n,)."""
        same: NDArray[np.bool_] = self.pool.identity[source.visible.slots] == source.visible.identity
        return same & source.left if isinstance(source, Waiting) else same

    def _fold(self, channels: Channels, keyframe: "Keyframe | Waiting", places: NDArray[np.intp]) -> None:
        """Let time pass up to a keyframe's stamp in some of its bricks, and add its messages to them."""
        if len(places) == 0:
            return
        slots = np.ascontiguousarray(keyframe.visible.slots[places])
        before = channels.stamp_s[slots]
        fold_bricks(
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
        age_bricks(
            slots, channels.now, channels.shown, channels.glimpsed, aging, self.pool.prior_log_odds,
            strip_length(),
        )  # fmt: skip
        channels.stamp_s[slots] = target_s
        self.pool.touch(slots)
        runtime.settle()  # before the arrays of the call are dropped

    def _aging(self, seconds: NDArray[np.float64]) -> Aging:
        """Effect of some seconds, (n); none where they are 0 or nothing was known before."""
        seconds = np.where(np.isfinite(seconds), np.maximum(seconds, 0.0), 0.0)
        forgotten = -np.expm1(-2.0 * self.time.flip_rate * seconds)
        lasting = 0.5 ** (seconds / self.time.glimpse_half_life_s)
        lasting[lasting < FORGOTTEN] = 0.0
        share = self.time.moving_share
        parts = (1.0 - forgotten, share * forgotten, (1.0 - share) * forgotten, lasting)
        return Aging(*(part.astype(np.float32) for part in parts))


SourceT = TypeVar("SourceT", bound="Keyframe | Waiting")


def in_time(keyframes: Iterable[SourceT]) -> list[SourceT]:
    """Keyframes by their stamps; those of one stamp by their content, so that the order does not depend on
    how they were added."""
    ordered: list[SourceT] = []
    for _, group in groupby(sorted(keyframes, key=lambda k: k.stamp_s), key=lambda k: k.stamp_s):
        same = list(group)
        ordered += sorted(same, key=_content) if len(same) > 1 else same
    return ordered


def _content(source: "Keyframe | Waiting") -> bytes:
    return source.content if isinstance(source, Waiting) else content_key(source)
