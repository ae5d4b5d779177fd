"""Which bricks to send to the viewer: those that differ from what was sent last.

The pool notes which bricks may have changed, so the cost depends on the changes and not on the size of the
map; comparing with what was sent leaves out the many bricks that inference has hardly changed.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import LOG_ODDS_STEP, Bricks, Layer, pack_log_odds
from taichi_mrf.voxels.layout import VOXELS, grid_keys
from taichi_mrf.voxels.pool import BrickPool

SeenBy = Callable[[NDArray[np.int32]], NDArray[np.uint8]]
"""Slots (n,) -> how many keyframes see each of their voxels, (n, 512)."""

Beliefs = Callable[[NDArray[np.int32]], NDArray[np.float32]]
"""Slots (n,) -> the log-odds of their voxels, (n, 512)."""

_AT_ONCE = 4096
"""Bricks that are read from the pool at once."""


class Publisher:
    """Finds the changes of one map since the last call."""

    def __init__(
        self,
        layer: Layer,
        pool: BrickPool,
        seen_by: SeenBy,
        *,
        prior_is_unknown: bool = False,
        least_log_odds: float | None = None,
        counting: bool = True,
        beliefs: Beliefs | None = None,
    ) -> None:
        """With ``prior_is_unknown`` a voxel that holds exactly the pool's prior is unobserved, as in maps
        that integrate scan by scan: it is sent as just less likely occupied than not, or all of them would
        be shown. With ``least_log_odds`` a brick counts only if it has a known voxel above that.
        ``counting``: send the number of keyframes that see each voxel, which reads every keyframe's messages.
        ``beliefs``: what to send of the pool's bricks, by default the pool's own beliefs.
        """
        self._layer, self._pool, self._seen_by = layer, pool, seen_by
        self._prior_is_unknown, self._least = prior_is_unknown, least_log_odds
        self.counting = counting
        self._beliefs = beliefs or (lambda slots: pool.read("belief", slots))
        self._sent = _SentBricks()
        self._identity = pool.identity.copy()
        self._all = True

    def changes(self, touched: NDArray[np.int32] | None = None) -> Bricks | None:
        """What has changed since the last call, None if nothing has. The first time that is the whole map.

        ``touched`` are the slots, ascending, that may have changed; by default the pool is asked.
        """
        touched = self._pool.take_touched() if touched is None else touched
        slots, self._all = (self._pool.in_use if self._all else touched), False
        parts = [self._changed(slots[i : i + _AT_ONCE]) for i in range(0, len(slots), _AT_ONCE)]
        hidden = [part[3] for part in parts]
        removed = np.concatenate([self._gone(), *hidden])
        if not len(removed) and not any(len(part[0]) for part in parts):
            return None
        empty = (np.zeros((0, 3), np.int32), np.zeros((0, VOXELS), np.int16), np.zeros((0, VOXELS), np.uint8))
        found = [np.concatenate([empty[i], *(part[i] for part in parts)]) for i in range(3)]
        return Bricks(self._layer, found[0], found[1], found[2], removed)

    def everything_gone(self) -> Bricks:
        """The update that removes everything that was sent."""
        empty = np.zeros((0, VOXELS))
        bricks = self._sent.bricks()
        self._sent, self._all = _SentBricks(), True
        return Bricks(
            self._layer, bricks[:0].copy(), empty.astype(np.int16), empty.astype(np.uint8), removed=bricks
        )

    def count(self, on: bool) -> None:
        """Start or stop counting the keyframes that see each voxel; all bricks are sent again."""
        if on != self.counting:
            self.counting = on
            self.start_over()

    def look_again(self) -> None:
        """Compare every brick with what was sent at the next call of :meth:`changes`."""
        self._all = True

    def start_over(self) -> None:
        """Send the whole map with the next changes: the viewer is a new one."""
        self._sent, self._all = _SentBricks(), True

    def _changed(
        self, slots: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int16], NDArray[np.uint8], NDArray[np.int32]]:
        """Of some bricks those that differ from what was sent: coordinates, log-odds, seen; and the bricks
        that are hidden now."""
        bricks, belief = self._pool.bricks[slots], self._beliefs(slots)
        log_odds = pack_log_odds(belief)
        seen = self._seen_by(slots) if self.counting else np.zeros(log_odds.shape, np.uint8)
        if self._prior_is_unknown:
            log_odds[belief == self._pool.prior_log_odds] = -1
        hidden = bricks[:0].copy()
        if self._least is not None:
            counts = (log_odds > self._least / LOG_ODDS_STEP).any(axis=1)
            hidden = self._sent.drop(bricks[~counts])
            bricks, log_odds, seen = bricks[counts], log_odds[counts], seen[counts]
        news = self._sent.note(bricks, log_odds, seen)
        return bricks[news], log_odds[news], seen[news], hidden

    def _gone(self) -> NDArray[np.int32]:
        """Bricks that were sent and do not exist any more."""
        before, self._identity = self._identity, self._pool.identity.copy()
        lived = before >= 0
        if (before[lived] == self._identity[: len(before)][lived]).all():
            return np.zeros((0, 3), np.int32)
        there = grid_keys(self._pool.bricks[self._pool.in_use])
        sent = self._sent.bricks()
        return self._sent.drop(sent[~np.isin(grid_keys(sent), there)])


class _SentBricks:
    """What was sent to the viewer, by brick: rows of arrays that grow."""

    def __init__(self) -> None:
        self._rows: dict[int, int] = {}
        self._free: list[int] = []
        self._bricks = np.zeros((0, 3), np.int32)
        self._log_odds = np.zeros((0, VOXELS), np.int16)
        self._seen = np.zeros((0, VOXELS), np.uint8)

    def bricks(self) -> NDArray[np.int32]:
        """The coordinates of all, (n, 3)."""
        return self._bricks[np.fromiter(self._rows.values(), np.int64, len(self._rows))]

    def note(
        self, bricks: NDArray[np.int32], log_odds: NDArray[np.int16], seen: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Note the content of some bricks, each at most once; returns which of them differ from before,
        (n,)."""
        keys = grid_keys(bricks).tolist()
        rows = np.array([self._rows.get(key, -1) for key in keys], np.int64)
        news = rows < 0
        old = np.flatnonzero(~news)
        same = (self._log_odds[rows[old]] == log_odds[old]).all(axis=1)
        same &= (self._seen[rows[old]] == seen[old]).all(axis=1)
        news[old] = ~same
        new = np.flatnonzero(rows < 0)
        self._reserve(len(new))
        for i in new.tolist():
            rows[i] = self._rows[keys[i]] = self._free.pop()
        into = rows[news]
        self._bricks[into], self._log_odds[into], self._seen[into] = bricks[news], log_odds[news], seen[news]
        return news

    def drop(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]:
        """Drop bricks; returns those of them that had been sent."""
        rows = [self._rows.pop(key, -1) for key in grid_keys(bricks).tolist()]
        self._free += [row for row in rows if row >= 0]
        return bricks[np.array(rows, np.int64) >= 0]

    def _reserve(self, count: int) -> None:
        more = count - len(self._free)
        if more <= 0:
            return
        size = len(self._bricks)
        more = max(more, size // 4, 64)
        self._free += range(size + more - 1, size - 1, -1)
        self._bricks = np.concatenate([self._bricks, np.zeros((more, 3), np.int32)])
        self._log_odds = np.concatenate([self._log_odds, np.zeros((more, VOXELS), np.int16)])
        self._seen = np.concatenate([self._seen, np.zeros((more, VOXELS), np.uint8)])
