"""Storage of voxels: arrays of bricks that grow, with a free list.

A brick has a slot; voxel v of the brick in slot s stands at s * 512 + v of each channel. The channels
are Taichi ndarrays, which kernels take as arguments, and not fields, for which they would be compiled
anew whenever the pool grows. What only the host needs (coordinates, owners, identities) is NumPy.
"""

import copy
import heapq
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array, I32Array, Template
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.numbering import strip_begin, strip_length

GROWTH = 1.2
"""A full pool grows by this factor: little enough that the slack does not show in the bytes a voxel."""

MOST_BRICKS = 2**31 // VOXELS - 1
"""Taichi refuses arrays of 2^31 elements."""


@dataclass(frozen=True)
class PoolSnapshot:
    """A pool at one moment: the sums of messages, what queries read, which bricks there were, and the counts
    by which what was found of the pool then is known again. ``undated``: other log-odds than the pool's."""

    total: "ti.Ndarray"
    belief: "ti.Ndarray"
    bricks: NDArray[np.int32]
    owners: NDArray[np.int32]
    revision: int
    restarts: int
    undated: bool


class Dated(Protocol):
    """Log-odds that queries read instead of the sums of messages, in a map whose evidence has a date."""

    def current(self) -> "ti.Ndarray":
        """The log-odds of all voxels (capacity * 512), brought up to date."""
        ...

    def start(self, slots: NDArray[np.int32]) -> None:
        """New bricks, (n,) slots: their voxels are at the prior."""
        ...

    def grow(self, old_capacity: int, capacity: int) -> None:
        """Make room for ``capacity`` bricks."""
        ...

    @property
    def bytes_per_voxel(self) -> int: ...


@dataclass(frozen=True)
class PoolPart:
    """Some bricks of a pool by themselves, as if there were no others: ``in_use`` are their slots here, in
    the order in which they were asked for, and ``belief`` (capacity * 512) their log-odds."""

    capacity: int
    in_use: NDArray[np.int32]
    belief: "ti.Ndarray"
    prior_log_odds: float


class BrickPool:
    """The map's bricks with their beliefs.

    ``total`` holds the log-odds of each voxel's marginal, the prior plus all messages; ``evidence``, once
    something has been frozen, the log-odds that inference starts from (prior plus frozen messages).
    Queries read ``belief``: ``total``, unless evidence is ``dated``.
    """

    def __init__(self, prior_log_odds: float, memory_limit_gb: float = 0.0) -> None:
        self.prior_log_odds = prior_log_odds
        self.memory_limit_gb = memory_limit_gb
        self.capacity = 0
        self.total = ti.ndarray(ti.f32, VOXELS)
        self.evidence: ti.Ndarray | None = None
        self.dated: Dated | None = None
        self._shown: ti.Ndarray | None = None
        self.shown: PoolSnapshot | None = None  # other log-odds instead of the pool's own
        self.bricks = np.zeros((0, 3), np.int32)
        self.owners = np.zeros(0, np.int32)
        self.identity = np.zeros(0, np.int64)
        self.change_count = np.zeros(0, np.int64)  # changed marginals in each brick since it was allocated
        self.revision = 0  # changes whenever the beliefs do
        self.restarts = 0  # how often all of them were set anew
        self._touched = np.zeros(0, bool)
        self._changed = np.zeros(0, bool)
        self._free: list[int] = []
        self._born = 0

    @property
    def belief(self) -> "ti.Ndarray":
        """The log-odds (capacity * 512) that queries read."""
        if self._shown is not None:
            return self._shown
        return self.total if self.dated is None else self.dated.current()

    @property
    def in_use(self) -> NDArray[np.int32]:
        """Slots of the bricks that exist, ascending."""
        return np.flatnonzero(self.owners > 0).astype(np.int32)

    @property
    def in_order(self) -> NDArray[np.int32]:
        """Slots of the bricks that exist, by coordinates: the order does not depend on the history."""
        slots = self.in_use
        return slots[np.lexsort(self.bricks[slots].T)]

    @property
    def bytes_per_voxel(self) -> int:
        """Bytes of the channels for each allocated voxel."""
        dated = 0 if self.dated is None else self.dated.bytes_per_voxel
        return (8 if self.evidence is not None else 4) + dated

    def allocate(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots for new bricks, (n, 3) -> (n,), their voxels at the prior and without owners.

        The lowest free slots go first, so that equal histories give equal pools.
        Raises CapacityError if there is not enough memory.
        """
        missing = len(bricks) - len(self._free)
        if missing > 0:
            self._grow(self.capacity + missing)
        slots = np.array([heapq.heappop(self._free) for _ in range(len(bricks))], np.int32)
        self.bricks[slots] = bricks
        # Identities are unique, so a slot that was freed and allocated again is recognised.
        self.identity[slots] = self._born + np.arange(len(bricks))
        self._born += len(bricks)
        self.change_count[slots] = 0
        self._changed[slots] = True
        self.touch(slots)
        fill_bricks(self.total, slots, self.prior_log_odds, strip_length())
        if self.evidence is not None:
            fill_bricks(self.evidence, slots, self.prior_log_odds, strip_length())
        if self.dated is not None:
            self.dated.start(slots)
        return slots

    def release(self, slots: NDArray[np.int32]) -> None:
        """Free bricks, which must have no owners."""
        self.identity[slots] = -1
        self.owners[slots] = 0
        for slot in slots.tolist():
            heapq.heappush(self._free, slot)

    def restart(self) -> None:
        """Set all beliefs to what inference starts from."""
        self.revision += 1
        self.restarts += 1
        self._touched[:] = True
        if self.evidence is not None:
            _copy(self.evidence, self.total, self.capacity, strip_length())
        else:
            self.total.fill(self.prior_log_odds)

    def touch(self, slots: NDArray[np.int32]) -> None:
        """Mark these bricks as possibly changed."""
        self._touched[slots] = True

    def take_touched(self) -> NDArray[np.int32]:
        """Slots, ascending, of the bricks that may have changed since this was last called."""
        slots = np.flatnonzero(self._touched & (self.owners > 0)).astype(np.int32)
        self._touched[:] = False
        return slots

    def count_changes(self, slots: NDArray[np.int32], moved: NDArray[np.int32]) -> None:
        """Count changed marginals in some bricks, (n,) each."""
        self.change_count[slots] += moved
        self._changed[slots[moved > 0]] = True

    def take_changed(self) -> NDArray[np.int32]:
        """Coordinates (n, 3) of the bricks that are new, or in which marginals have changed, since this was
        last called."""
        bricks = self.bricks[self._changed & (self.owners > 0)]
        self._changed[:] = False
        return bricks

    def snapshot(self, undated: bool = False) -> PoolSnapshot:
        """The bricks and beliefs as they are now, which later changes do not touch. With ``undated``, queries
        that are shown the snapshot read its sums of messages."""
        total = copied(self.total)
        belief = total if undated or self.dated is None else copied(self.belief)
        state = self.bricks.copy(), self.owners.copy(), self.revision, self.restarts
        return PoolSnapshot(total, belief, *state, undated)

    def restore(self, snapshot: PoolSnapshot) -> None:
        """Set the sums of messages back to a snapshot's. The bricks must still be the same."""
        self.revision += 1
        self.restarts += 1
        self._touched[:] = True
        _copy(snapshot.total, self.total, snapshot.total.shape[0] // VOXELS, strip_length())
        runtime.settle()  # before the snapshot is dropped

    @contextmanager
    def showing(self, snapshot: PoolSnapshot) -> Iterator[None]:
        """Let queries and files see a snapshot while the block runs, which must not change the pool."""
        now = self._shown, self.bricks, self.owners, self.shown, self.total, self.revision, self.restarts
        touched = self._touched.copy()  # whoever takes it now has looked at the snapshot
        self._shown, self.bricks, self.owners = snapshot.belief, snapshot.bricks, snapshot.owners
        if snapshot.undated:
            self.shown = snapshot
        else:
            self.total, self.revision, self.restarts = snapshot.total, snapshot.revision, snapshot.restarts
        try:
            yield
        finally:
            self._shown, self.bricks, self.owners, self.shown, self.total, self.revision, self.restarts = now
            self._touched |= touched

    def with_beliefs(self, belief: "ti.Ndarray") -> "BrickPool":
        """The bricks as they are now, with these log-odds (capacity * 512), whatever is shown instead of the
        pool's own. It is for queries alone."""
        other = copy.copy(self)
        other.dated, other.total, other._shown = None, belief, None
        other.bricks, other.owners = self.bricks.copy(), self.owners.copy()
        return other

    def keep_evidence(self) -> "ti.Ndarray":
        """The evidence channel, made when something is frozen for the first time."""
        if self.evidence is None:
            self.evidence = ti.ndarray(ti.f32, max(1, self.capacity) * VOXELS)
            self.evidence.fill(self.prior_log_odds)
        return self.evidence

    def read(self, channel: str, slots: NDArray[np.int32]) -> NDArray[np.float32]:
        """The voxels of some bricks, (n, 512), from the channel "belief", "total" or "evidence"."""
        out = np.zeros(len(slots) * VOXELS, np.float32)
        if len(slots):
            read_bricks(getattr(self, channel), slots, out, strip_length())
        return out.reshape(-1, VOXELS)

    def showing_others(self, log_odds: "ti.Ndarray") -> "BrickPool":
        """View of these bricks whose beliefs are other log-odds (capacity * 512)."""
        other = copy.copy(self)
        other._shown = log_odds
        return other

    def part(self, slots: NDArray[np.int32]) -> PoolPart:
        """Some bricks, (n,) slots, by themselves, as they are now."""
        belief = ti.ndarray(ti.f32, max(1, len(slots)) * VOXELS)
        if len(slots):
            read_bricks(self.belief, slots, belief, strip_length())
        return PoolPart(len(slots), np.arange(len(slots), dtype=np.int32), belief, self.prior_log_odds)

    def write(self, channel: str, slots: NDArray[np.int32], values: NDArray[np.float32]) -> None:
        """Set the voxels of some bricks, (n, 512), of the channel "total" or "evidence"."""
        self.revision += 1
        if channel == "evidence":
            self.keep_evidence()
        self.touch(slots)
        flat = np.ascontiguousarray(values, np.float32).reshape(-1)
        write_bricks(getattr(self, channel), slots, flat, strip_length())

    def _affordable(self) -> int:
        """Bricks that the memory limit, if there is one, has room for."""
        if self.memory_limit_gb <= 0:
            return MOST_BRICKS
        return int(self.memory_limit_gb * 1e9) // (VOXELS * self.bytes_per_voxel)

    def _grow(self, bricks_needed: int) -> None:
        if bricks_needed > MOST_BRICKS:
            raise CapacityError(
                f"the map would hold {bricks_needed * VOXELS:.3g} voxels, but at most "
                f"{MOST_BRICKS * VOXELS:.3g} are possible; choose larger voxels"
            )
        check_memory(
            bricks_needed * VOXELS * self.bytes_per_voxel,
            f"{bricks_needed * VOXELS / 1e6:.3g} million voxels",
            self.memory_limit_gb,
        )
        capacity = max(bricks_needed, min(MOST_BRICKS, int(self.capacity * GROWTH), self._affordable()), 256)
        self.total = grown(self.total, self.capacity, capacity)
        if self.evidence is not None:
            self.evidence = grown(self.evidence, self.capacity, capacity)
        if self.dated is not None:
            self.dated.grow(self.capacity, capacity)
        more = capacity - self.capacity
        self.bricks = np.concatenate([self.bricks, np.zeros((more, 3), np.int32)])
        self.owners = np.concatenate([self.owners, np.zeros(more, np.int32)])
        self.identity = np.concatenate([self.identity, np.full(more, -1, np.int64)])
        self.change_count = np.concatenate([self.change_count, np.zeros(more, np.int64)])
        self._touched = np.concatenate([self._touched, np.zeros(more, bool)])
        self._changed = np.concatenate([self._changed, np.zeros(more, bool)])
        for slot in range(self.capacity, capacity):
            heapq.heappush(self._free, slot)
        self.capacity = capacity


def copied(channel: "ti.Ndarray") -> "ti.Ndarray":
    """A copy of a channel (capacity * 512)."""
    bricks = channel.shape[0] // VOXELS
    return grown(channel, bricks, bricks)


def grown(old: "ti.Ndarray", old_capacity: int, capacity: int) -> "ti.Ndarray":
    """A channel with room for ``capacity`` bricks, which holds the voxels of the old one."""
    new = ti.ndarray(old.dtype, capacity * VOXELS)
    _copy(old, new, old_capacity, strip_length())
    runtime.settle()
    return new


@ti.kernel
def _copy(source: AnyArray, target: AnyArray, bricks: I32, strip: Template):
    """Copy the voxels of the first ``bricks`` bricks. ``source`` and ``target`` are channels (capacity *
    512); ``strip`` here and below: voxels/numbering.py."""
    for part in range(bricks * (VOXELS // strip)):
        for k in range(strip):
            target[part * strip + k] = source[part * strip + k]


@ti.kernel
def fill_bricks(channel: F32Array, slots: I32Array, value: F32, strip: Template):
    """Set all voxels of the bricks in ``slots`` (n) of a ``channel`` (capacity * 512)."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, j = strip_begin(part, slots, strip)
        for k in range(strip):
            channel[j + k] = value


@ti.kernel
def read_bricks(channel: F32Array, slots: I32Array, out: F32Array, strip: Template):
    """Copy the bricks in ``slots`` (n) of a ``channel`` (capacity * 512) to ``out`` (n * 512)."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            out[i + k] = channel[j + k]


@ti.kernel
def write_bricks(channel: F32Array, slots: I32Array, values: F32Array, strip: Template):
    """Copy ``values`` (n * 512) to the bricks in ``slots`` (n) of a ``channel`` (capacity * 512)."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            channel[j + k] = values[i + k]
