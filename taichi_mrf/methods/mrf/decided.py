"""Occupied voxels of an MRFMap: those whose marginal is over one half, those that win the vote of the rays,
and those that a thin thing goes through (inference/thin_matter.py).

A wall that is seen with a sigma of several voxels has no voxel that is more likely occupied than not, and yet
the rays agree on where it is (inference/surface_votes.py). After a full :meth:`infer` all votes are counted
anew, so states follow from the set of keyframes alone. While keyframes come, the votes of those that were
counted before stay as they were, and a new keyframe costs its own rays.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.brick_sums import VOTES
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.methods.brick_registry import BrickRegistry
from taichi_mrf.methods.mrf.kept_rays import KeptRays
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.later import later
from taichi_mrf.voxels.calls import calls_of
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import PoolSnapshot, copied, grown

if TYPE_CHECKING:
    from taichi_mrf.inference import dated, surface_votes, thin_matter
else:
    dated, surface_votes, thin_matter = later("taichi_mrf.inference", "dated", "surface_votes", "thin_matter")

AT_ONCE = 16
"""Keyframes whose votes are counted together: they share what their rays read of the map."""


class Decisions:
    """The votes of one map's rays, and the log-odds by which its voxels are occupied."""

    def __init__(
        self,
        registry: BrickRegistry,
        keyframes: Mapping[int, Keyframe],
        kept: KeptRays,
        sweeper: Sweeper,
    ) -> None:
        """``keyframes`` are those of the map, now and later; ``kept`` has the votes that frozen ones have
        left, and ``sweeper`` what rays share."""
        self._registry, self._keyframes, self._kept, self._sweeper = registry, keyframes, kept, sweeper
        self._votes = ti.ndarray(ti.i32, VOTES * VOXELS)
        self._identity = np.zeros(0, np.int64)
        self._counted: dict[int, Keyframe] = {}
        self._restarts = -1  # of the pool when votes were counted; -1 while they are not complete
        self._shown: PoolSnapshot | None = None
        self._exact = False

    @property
    def nbytes(self) -> int:
        """Bytes of the votes."""
        return 4 * int(self._votes.shape[0])

    def log_odds(self, settled: bool, between: Callable[[], object] = lambda: None) -> "ti.Ndarray":
        """Log-odds (capacity * 512) above 0 in occupied voxels, the marginals' in all others. In a
        ``settled`` map they follow from the keyframes alone. ``between`` is called after each keyframe; what
        it raises ends the work."""
        pool = self._registry.pool
        self._count(settled, between)
        log_odds = copied(pool.belief)
        surface_votes.call_winners(
            self._votes, log_odds, pool.prior_log_odds, self._sweeper.volume.min_evidence
        )
        runtime.settle()
        return log_odds

    def call_matter(self, log_odds: "ti.Ndarray") -> None:
        """Change :meth:`log_odds` where something stops single rays (thin_matter.call_matter)."""
        pool, sweeper = self._registry.pool, self._sweeper
        known = pool.prior_log_odds, sweeper.volume.min_evidence
        thin_matter.call_matter(self._votes, log_odds, pool.bricks, pool.in_use, sweeper.voxel_size, *known)

    def calls(self, settled: bool) -> NDArray[np.uint8]:
        """The verdict of the rays on voxels beyond the marginals, (slots, 512) (voxels/calls.py)."""
        log_odds, pool = self.log_odds(settled), self._registry.pool
        self.call_matter(log_odds)
        known = pool.prior_log_odds, self._sweeper.volume.min_evidence
        calls = calls_of(log_odds.to_numpy(), pool.belief.to_numpy(), *known)
        return calls[: pool.capacity * VOXELS].reshape(-1, VOXELS)

    def frozen(self, id: int) -> None:
        """A keyframe was frozen: its votes stay until all are counted anew."""
        self._counted.pop(id, None)

    def _count(self, settled: bool, between: Callable[[], object]) -> None:
        """Bring the votes up to date."""
        pool = self._registry.pool
        gone = any(self._keyframes.get(id) is not keyframe for id, keyframe in self._counted.items())
        other_beliefs = self._restarts != pool.restarts or self._shown is not pool.shown
        if gone or other_beliefs or self._comes_late() or (settled and not self._exact):
            self._start_over()
        else:
            self._follow_bricks()
        new = [keyframe for id, keyframe in self._keyframes.items() if id not in self._counted]
        new = dated.in_time(new) if self._changing else new
        self._exact = settled if new else self._exact
        for begin in range(0, len(new), AT_ONCE):
            some = new[begin : begin + AT_ONCE]
            self._add(some, between)
            self._counted.update((keyframe.id, keyframe) for keyframe in some)
        self._restarts, self._shown = pool.restarts, pool.shown

    @property
    def _changing(self) -> bool:
        """True in a world that may change, where scores fade from keyframe to keyframe."""
        return self._registry.pool.dated is not None

    def _comes_late(self) -> bool:
        """True if scores fade, and a new keyframe is older than one that was counted."""
        if not self._changing or not self._counted:
            return False
        newest_s = max(keyframe.stamp_s for keyframe in self._counted.values())
        return any(k.stamp_s <= newest_s for id, k in self._keyframes.items() if id not in self._counted)

    def _start_over(self) -> None:
        """Forget all votes but those that frozen keyframes have left."""
        pool, kept = self._registry.pool, self._kept.share.votes
        self._counted, self._exact, self._restarts = {}, True, -1
        self._votes = surface_votes.no_votes(pool.belief.shape[0])
        self._identity = pool.identity.copy()
        if len(kept.bricks):
            slots = self._registry.topology.slots(kept.bricks)
            sums = kept.sums[slots >= 0].reshape(-1, VOTES)
            if self._changing:
                most = surface_votes.LASTING
                sums = np.stack([sums[:, 0], np.clip(sums[:, 1], -most, most)], axis=1)
            surface_votes.set_votes(slots[slots >= 0], np.ascontiguousarray(sums.reshape(-1)), self._votes)

    def _add(self, keyframes: Sequence[Keyframe], between: Callable[[], object]) -> None:
        """Add the votes of some keyframes' rays. Only the bricks that they see are looked at."""
        lists = [self._registry.visible(keyframe.footprint) for keyframe in keyframes]
        seen = np.zeros(self._registry.pool.capacity, bool)
        for visible in lists:
            seen[visible.slots] = True
        slots = np.flatnonzero(seen).astype(np.int32)
        part = self._registry.pool.part(slots)
        places = [np.searchsorted(slots, visible.slots).astype(np.int32) for visible in lists]
        there = [replace(visible, slots=at, arrays=None) for visible, at in zip(lists, places, strict=True)]
        votes = surface_votes.no_votes(part.belief.shape[0])
        surface_votes.move_votes(slots, self._votes, votes, 0)
        surface_votes.count_votes(
            zip(keyframes, there, strict=True), part, self._sweeper.model(), self._sweeper.volume, votes,
            self._changing, between,
        )  # fmt: skip
        surface_votes.move_votes(slots, self._votes, votes, 1)

    def _follow_bricks(self) -> None:
        """Forget the votes of bricks that are gone, and make room for new ones."""
        pool, before = self._registry.pool, self._identity
        held, needed = self.nbytes // (4 * VOTES * VOXELS), pool.belief.shape[0] // VOXELS
        if held < needed:
            self._votes = grown(self._votes, VOTES * held, VOTES * needed)
        if np.array_equal(before, pool.identity):
            return
        self._identity = pool.identity.copy()
        gone = np.flatnonzero(before != self._identity[: len(before)]).astype(np.int32)
        surface_votes.clear_votes(gone[gone < held], self._votes)
