"""The colours that cameras saw, as the page shows them: what has changed of them since they were sent."""

import hashlib
import math
import time

import numpy as np

from taichi_mrf.live.mapper import Mapper
from taichi_mrf.methods.capabilities import takes_colors
from taichi_mrf.queries.colored import painted
from taichi_mrf.viewer.messages import BrickColors
from taichi_mrf.voxels.layout import VOXELS, by_chunk

SHARE_OF_TIME = 0.1
"""Looking for new colours takes at most this share of the time while frames come."""


class ShownColors:
    """Finds the colours to send of one map. While keyframes come, only theirs are added; once the map has
    settled, all are computed from its final marginals."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._sent: dict[tuple[int, int, int], bytes] = {}
        self._next = -math.inf
        self._seen: tuple[int, bool, int] | None = None

    def changes(self) -> list[BrickColors]:
        """The colours of the chunks that have changed since the last call, chunk by chunk; none if that was a
        moment ago."""
        m, begin = self._mapper.map, time.monotonic()
        if not takes_colors(m) or not m.has_colors or (begin < self._next and not m.settled):
            return []
        pool = m.view.pool
        state = pool.revision, m.settled, len(m.keyframes)
        if state == self._seen:
            return []
        self._seen = state
        slots = pool.in_use
        found = m.colors_in(slots) if m.settled else m.recent_colors().reshape(-1, VOXELS, 4)[slots]
        news = []
        for chunk, rows in by_chunk(pool.bricks[slots]):
            colors = painted(found[rows])
            digest = hashlib.blake2b(colors.tobytes(), digest_size=8).digest()
            if self._sent.get(chunk) != digest:
                self._sent[chunk] = digest
                news.append(BrickColors(chunk, np.ascontiguousarray(pool.bricks[slots[rows]]), colors))
        now = time.monotonic()
        self._next = now + (now - begin) / SHARE_OF_TIME
        return news
