"""Updates that wait to be sent to the viewer; an update that a later one replaces is never sent.

A viewer that is slower than mapping, or suspended, must not slow mapping down or fill its memory. So an
update replaces an older one of its kind, and bricks are merged brick by brick: what waits is never larger
than the map and its keyframes.
"""

import threading
from collections.abc import Callable, Hashable
from typing import Union

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import (
    BEAT_S,
    Alive,
    BrickColors,
    Bricks,
    CurrentCamera,
    File,
    Hello,
    Images,
    KeyframeInfo,
    Layer,
    MeasuredPoints,
    Notice,
    Quit,
    RayAnswer,
    SceneChanges,
    Status,
    SurfacePatch,
    SurfaceView,
    TimeSpan,
    Update,
    Votes,
)
from taichi_mrf.voxels.layout import grid_keys

BRICKS_AT_ONCE = 2048
"""Bricks sent in one piece (3 MB), so that other updates need not wait for a whole map."""

MOST = {Notice: 50, File: 4}
"""Most updates of these kinds that wait; the oldest are dropped first."""

LATEST_ONLY = (
    Status, CurrentCamera, Images, MeasuredPoints, RayAnswer, Votes, TimeSpan, SceneChanges, SurfaceView,
)  # fmt: skip

MERGE_FACTOR = 2
"""Waiting bricks are merged when their number has grown by this factor since the last merge, so that each is
copied a few times at most."""


Waiting = Union[Update, "WaitingBricks", Quit]


class Outbox:
    """A queue that one thread fills and another empties.

    A page with further kinds of updates defines in a subclass which of them replace each other
    (:meth:`key`), and which waiting updates a new one makes obsolete (:meth:`still_wanted`).
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: dict[Hashable, Waiting] = {}
        self._number = 0
        self._closed = False

    def put(self, update: Update) -> None:
        """Add an update; returns at once."""
        with self._changed:
            if self._closed:
                return
            wanted = self.still_wanted(update)
            if wanted is not None:
                self._waiting = {key: waiting for key, waiting in self._waiting.items() if wanted(waiting)}
            if isinstance(update, Bricks):
                waiting = self._waiting.setdefault(("bricks", update.layer), WaitingBricks(update.layer))
                assert isinstance(waiting, WaitingBricks)
                waiting.add(update)
            else:
                self._waiting[self._place(update)] = update
            self._changed.notify()

    def close(self) -> None:
        """Drop all waiting updates; :meth:`take` then returns Quit."""
        with self._changed:
            self._waiting = {"quit": Quit()}
            self._closed = True
            self._changed.notify()

    def take(self) -> Update | Quit:
        """Wait for the next update; Alive if none comes for a while. Nothing follows after Quit."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._waiting, BEAT_S):
                return Alive()
            key = next(iter(self._waiting))
            update = self._waiting.pop(key)
            if isinstance(update, WaitingBricks):
                part, rest = update.take(BRICKS_AT_ONCE)
                if rest is not None:
                    self._waiting[key] = rest
                return part
            return update

    def __len__(self) -> int:
        """Updates that wait."""
        with self._changed:
            return len(self._waiting)

    def key(self, update: Update) -> Hashable | None:
        """Updates with the same key replace each other; None: the update waits beside others of its kind, up
        to MOST of them."""
        if isinstance(update, LATEST_ONLY):
            return type(update).__name__
        if isinstance(update, KeyframeInfo):
            return "keyframe", update.id
        if isinstance(update, BrickColors):
            return update.layer, update.chunk
        if isinstance(update, SurfacePatch):
            return "surface", update.chunk
        if isinstance(update, Hello):
            return Hello.__name__
        return None

    def still_wanted(self, update: Update) -> Callable[[Waiting], bool] | None:
        """Which waiting updates are still sent after this one; None: all. A Hello makes earlier updates of
        the map obsolete. A view of the surface follows all its patches."""
        if isinstance(update, SurfaceView):
            return lambda waiting: not isinstance(waiting, SurfaceView)
        return (lambda waiting: isinstance(waiting, Notice | File)) if isinstance(update, Hello) else None

    def _place(self, update: Update) -> Hashable:
        """The key under which an update waits. Drops older updates of its kind if there are too many."""
        key = self.key(update)
        if key is not None:
            return key
        self._number += 1
        kind = type(update)
        same = [key for key in self._waiting if isinstance(key, tuple) and key[0] is kind]
        for key in same[: max(0, len(same) + 1 - MOST[kind])]:
            del self._waiting[key]
        return kind, self._number


class WaitingBricks:
    """The bricks of one layer that wait, merged as late as possible."""

    def __init__(self, layer: Layer, first: Bricks | None = None) -> None:
        self.layer = layer
        self._parts = [] if first is None else [first]
        self._merged = 0 if first is None else len(first.bricks) + len(first.removed)

    def add(self, bricks: Bricks) -> None:
        """Later bricks take the place of earlier ones."""
        self._parts.append(bricks)
        if sum(len(p.bricks) + len(p.removed) for p in self._parts) > MERGE_FACTOR * self._merged:
            self._merge()

    def take(self, count: int) -> tuple[Bricks, "WaitingBricks | None"]:
        """Up to ``count`` of the bricks, with all removed ones, and the bricks that still wait."""
        whole = self._merge()
        part = _rows(whole, slice(count), whole.removed)
        if len(whole.bricks) <= count:
            return part, None
        return part, WaitingBricks(self.layer, _rows(whole, slice(count, None), whole.removed[:0]))

    def _merge(self) -> Bricks:
        whole = self._parts[0] if len(self._parts) == 1 else merged(self._parts)
        self._parts = [whole]
        self._merged = len(whole.bricks) + len(whole.removed)
        return whole


def merged(parts: list[Bricks]) -> Bricks:
    """Several updates of one layer as a single one with the same effect."""
    bricks = np.concatenate([part.bricks for part in parts])
    log_odds = np.concatenate([part.log_odds for part in parts])
    seen = np.concatenate([part.seen for part in parts])
    removed = np.concatenate([part.removed for part in parts])
    # The last update of each brick counts. No update has a brick twice.
    said = np.concatenate([np.full(len(p.bricks), i) for i, p in enumerate(parts)])
    gone = np.concatenate([np.full(len(p.removed), i) for i, p in enumerate(parts)])
    keys = grid_keys(np.concatenate([bricks, removed]))
    order = np.lexsort((np.concatenate([said, gone]), keys))
    last = order[np.append(np.diff(keys[order]) != 0, True)] if len(order) else order
    kept, dropped = np.sort(last[last < len(bricks)]), np.sort(last[last >= len(bricks)]) - len(bricks)
    return Bricks(parts[0].layer, bricks[kept], log_odds[kept], seen[kept], removed[dropped])


def _rows(whole: Bricks, rows: slice, removed: NDArray[np.int32]) -> Bricks:
    return Bricks(whole.layer, whole.bricks[rows], whole.log_odds[rows], whole.seen[rows], removed)
