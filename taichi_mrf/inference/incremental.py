"""Incremental inference: which keyframes to sweep again after the beliefs of their voxels have changed.

A keyframe's messages follow from its cavity beliefs. The pool counts, for each brick, how often marginals
have changed; a keyframe keeps the counts at its last sweep. The difference is the share of its cavity that is
out of date, and the keyframe with the largest share is swept first. Keyframes far from all changed bricks are
not examined, so a new keyframe costs no more in a large map.
"""

import time
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.inference.keyframe_bounds import KeyframeBounds
from taichi_mrf.inference.messages import places_of
from taichi_mrf.inference.schedule import InferProgress, InferReport, NoteSweep, Progress
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.system import runtime
from taichi_mrf.system.interrupts import interrupts_wait
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool


def moved_share(keyframe: Keyframe, pool: BrickPool) -> float:
    """The share of the voxels seen by a keyframe whose marginals have moved since its last sweep; 1 if it was
    never swept. A marginal counts each time that it moves by over 0.01, a brick as its voxels at most."""
    visible = keyframe.visible if keyframe.pending_visible is None else keyframe.pending_visible
    seen_count = keyframe.change_count_at_last_sweep
    if seen_count is None or keyframe.messages is None:
        return 1.0
    if len(seen_count) == 0:
        return 0.0
    moved = np.minimum(pool.change_count[visible.slots] - seen_count, VOXELS)
    return float(moved.sum()) / (len(moved) * VOXELS)


def change_count_of(
    visible: VisibleBricks, old: VisibleBricks, change_count: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The change counts at a keyframe's last sweep for a newer list of its bricks, from those for the ``old``
    one. A brick that was not on that counts as changed in all voxels."""
    place = places_of(old, visible)
    return np.where(place >= 0, np.append(change_count, 0)[place], -VOXELS)


class IncrementalInference:
    """Sweeps the most affected keyframes until none is affected by more than the tolerance."""

    def __init__(
        self,
        pool: BrickPool,
        sweeper: Sweeper,
        bounds: KeyframeBounds,
        look_again: Callable[[Keyframe], object],
        refresh: Callable[[Keyframe], object],
        usual: float,
        note_sweep: NoteSweep | None = None,
    ) -> None:
        """``look_again`` brings the list of a keyframe's bricks up to date, ``refresh`` its messages too;
        ``usual`` is the tolerance above which a keyframe waits even if a call tolerates more. ``note_sweep``
        is called after each sweep."""
        self.pool, self.sweeper, self.bounds, self.usual = pool, sweeper, bounds, usual
        self.look_again, self.refresh = look_again, refresh
        self._note_sweep = note_sweep
        self._waiting: set[int] = set()

    def run(
        self,
        keyframes: Mapping[int, Keyframe],
        first: Iterable[int],
        tolerance: float,
        seconds: float | None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Sweep ``first``, in their order, then the most affected keyframe, until none is affected by more
        than ``tolerance`` or the time is over; what is left waits for the next call.

        ``residual`` of the report is the largest share that is left; ``complete`` is False if it is more than
        the tolerance.
        """
        begin = time.perf_counter()
        rays = swept = 0
        queue = list(first)
        largest = 0.0
        shares: dict[int, float] = {}  # of those that wait, as of when they were last examined
        outdated = set(self._waiting)
        while True:
            near = self.bounds.near(self.pool.take_changed())
            self._waiting |= near
            outdated |= near
            if queue:
                id = queue.pop(0)
            else:
                self._examine(keyframes, outdated, shares, tolerance)
                outdated.clear()
                largest = max(shares.values(), default=0.0)
                if largest <= tolerance:
                    largest = 0.0
                    break
                id = max(shares, key=lambda each: (shares[each], -each))
                if seconds is not None and time.perf_counter() - begin >= seconds:
                    break
            self.sweep(keyframes[id])
            outdated.add(id)
            rays, swept = rays + keyframes[id].rays, swept + 1
            if progress is not None and not progress(InferProgress(1, 1, swept, swept, keyframes[id].rays)):
                break
        runtime.settle()
        return InferReport(time.perf_counter() - begin, largest, swept, rays, largest <= tolerance)

    def sweep(self, keyframe: Keyframe) -> None:
        """Sweep one keyframe. Those whose cavity it changes are found by the next :meth:`run`."""
        with interrupts_wait():
            self.refresh(keyframe)
            self.pool.touch(keyframe.visible.slots)
            if self.sweeper.sweep(keyframe, self.pool):
                moved = self.sweeper.take_moved(keyframe, self.pool)
                if self._note_sweep is not None:
                    self._note_sweep(keyframe, moved)
            else:
                keyframe.change_count_at_last_sweep = np.zeros(0, np.int64)  # it sees no brick

    def _examine(
        self,
        keyframes: Mapping[int, Keyframe],
        outdated: set[int],
        shares: dict[int, float],
        tolerance: float,
    ) -> None:
        """Find the share of each waiting keyframe's cavity that is out of date, where ``shares`` are
        ``outdated``. Keyframes whose share is small enough wait no longer, nor do withdrawn ones."""
        for id in outdated & self._waiting & keyframes.keys():
            self.look_again(keyframes[id])
            shares[id] = 0.0 if keyframes[id].withdrawn else moved_share(keyframes[id], self.pool)
        least = min(tolerance, self.usual)
        for id in [id for id, share in shares.items() if share <= least]:
            del shares[id]
        self._waiting = set(shares)
