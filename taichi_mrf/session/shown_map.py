"""Map as the page shows it: as it is believed now or was believed at another time, with its dynamic voxels as
a layer of their own.

The past is read again only from time to time, because that takes all messages. What is occupied now takes a
pass over new keyframes' rays: it is found when there is time, and until then marginals are shown; a map that
was saved at rest is first shown by what is occupied.
"""

import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.methods.capabilities import has_dates, has_layers
from taichi_mrf.methods.mrf.moving_voxels import NOTHING_MOVES, Moving
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.session.publish import Publisher
from taichi_mrf.viewer.messages import LOG_ODDS_STEP, Bricks
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool

RENEW_SECONDS = 1.0
"""Shortest time between two readings of the map as of the same time, in seconds."""

NOT_DYNAMIC = -1.0
"""The log-odds that are sent of voxels outside the dynamic layer: any below 0 will do."""


class ShownMap:
    """Finds what to send of a map. ``stamp_s`` is the time that is shown, None for now."""

    def __init__(self, m: OccupancyMap, opened: bool = False) -> None:
        """An ``opened`` map is one from a file, at rest: nothing is sent of it before what is occupied."""
        self.map = m
        self.stamp_s: float | None = None
        self._pool = m.view.pool
        self._past = self._pool  # what is shown: the map as of stamp_s, or by votes
        self._outdated, self._read_at = False, -math.inf  # whether renew() has something to do
        self._decided_of: int | None = None  # the revision of the pool of which votes are shown
        self._undecided = False  # it failed
        self._held_back = self._pool.revision if opened and has_layers(m) else None  # until another one
        self.publisher = Publisher(
            "map",
            self._pool,
            m.seen_by,
            prior_is_unknown=m.METHOD.prior_is_unknown,
            counting=False,
            beliefs=self._beliefs,
        )
        self._moving = NOTHING_MOVES
        self._dynamic: Publisher | None = None
        if has_dates(m):
            # Packed log-odds of 0 count as occupied.
            least = -0.5 * LOG_ODDS_STEP
            self._dynamic = Publisher(
                "dynamic",
                self._pool,
                m.seen_by,
                least_log_odds=least,
                counting=False,
                beliefs=self._dynamic_beliefs,
            )

    @property
    def has_dates(self) -> bool:
        """True if the map can be shown as of another time."""
        return self._dynamic is not None

    def show(self, stamp_s: float | None) -> None:
        """Show the map as of a time in seconds, None for now; :meth:`renew` does the work."""
        if self.has_dates and stamp_s != self.stamp_s:
            self.stamp_s, self._outdated, self._read_at = stamp_s, True, -math.inf
            self._decided_of = None
            if stamp_s is None:
                self._past = self._pool
                self._look_again()

    def changes(self) -> list[Bricks]:
        """Changes of each layer since the last call; empty while a past time is shown, and :meth:`renew`
        follows. Votes are those of an earlier map, and marginals take their place."""
        self._outdated = self.stamp_s is not None
        if self._outdated or self._held_back == self._pool.revision:
            return []
        if self._decided_of not in (None, self._pool.revision):
            self._show_marginals()
        return self._changes()

    @property
    def lacks_decisions(self) -> bool:
        """True if :meth:`decide` has something to do."""
        able = has_layers(self.map) and not self._undecided
        return able and self.stamp_s is None and self._decided_of != self._pool.revision

    def decide(self, between: Callable[[], object]) -> list[Bricks]:
        """Show what is occupied; returns what has changed of each layer. ``between`` is called after each
        keyframe; what it raises ends the work."""
        assert has_layers(self.map)
        self._past, self._decided_of = self.map.decide(between).view.pool, self._pool.revision
        self._held_back = None
        self._look_again()
        return self._changes()

    def give_up_deciding(self) -> None:
        """Show marginals from now on."""
        self._undecided, self._held_back = True, None
        self._show_marginals()

    def renew(self) -> list[Bricks]:
        """Go to another time, or read the past again if the map has changed and a moment has gone by.
        Returns what has changed of each layer."""
        if not self._outdated or time.monotonic() - self._read_at < RENEW_SECONDS:
            return []
        if self.stamp_s is not None:
            assert has_dates(self.map)
            self._past = self.map.layer(stamp_s=self.stamp_s).view.pool
            self._look_again()
            self._read_at = time.monotonic()
        self._outdated = False
        return self._changes()

    def start_over(self) -> None:
        """Send everything with the next changes: the viewer is a new one."""
        self.show(None)
        for publisher in self._publishers():
            publisher.start_over()

    def _changes(self) -> list[Bricks]:
        found = [self.publisher.changes()]
        if self._dynamic is not None:
            before, size = self._moving.slots, self.map.voxel_size
            self._moving = Moving.of(self._pool, self._shown_pool, size)
            slots = np.union1d(before, self._moving.slots).astype(np.int32)
            found.append(self._dynamic.changes(slots[self._pool.owners[slots] > 0]))
        return [bricks for bricks in found if bricks is not None]

    @property
    def _shown_pool(self) -> BrickPool:
        """The bricks with the marginals of the time that is shown."""
        return self._pool if self.stamp_s is None else self._past

    def _publishers(self) -> list[Publisher]:
        return [self.publisher] if self._dynamic is None else [self.publisher, self._dynamic]

    def _show_marginals(self) -> None:
        self._past, self._decided_of = self._pool, None
        self._look_again()

    def _look_again(self) -> None:
        for publisher in self._publishers():
            publisher.look_again()

    def _beliefs(self, slots: NDArray[np.int32]) -> NDArray[np.float32]:
        return self._past.read("belief", slots)

    def _dynamic_beliefs(self, slots: NDArray[np.int32]) -> NDArray[np.float32]:
        """Of some bricks the log-odds of what moves, (n,) slots -> (n, 512)."""
        out = np.full((len(slots), VOXELS), NOT_DYNAMIC, np.float32)
        _, rows, places = np.intersect1d(slots, self._moving.slots, return_indices=True)
        belief = self._shown_pool.read("belief", slots[rows])
        out[rows] = np.where(self._moving.voxels[places], belief, np.float32(NOT_DYNAMIC))
        return out
