"""What appeared in the scene and what left it, as the page lists it: the map now against the map as it was
believed at the last comparison."""

import math
import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.methods.capabilities import has_dates
from taichi_mrf.queries.change import compare_maps
from taichi_mrf.queries.changed_things import find_changed_things, without_slack
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.viewer.messages import SceneChange, SceneChanges
from taichi_mrf.voxels.layout import grid_keys

MOST_LISTED = 6

REACH_M = 0.1
"""Parts that are nearer to each other than this are one thing."""

LEAST_VOLUME_M3 = 0.003
"""Smaller clusters of changed voxels are not listed: edges of surfaces change with noise. The surface of a
ball of 25 cm radius that one view sees has twice this volume in voxels of 5 cm."""

LEAST_VOXELS = 24
"""As many voxels of 5 cm have that volume. Fewer of larger ones come and go where a lidar's rays are far
apart."""

SHARE_OF_TIME = 0.05
"""Comparisons take at most this share of the time."""


class ChangeList:
    """The changes of one map, the latest first."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._changes: deque[SceneChange] = deque(maxlen=MOST_LISTED)
        self._compared_s: float | None = None  # the newest stamp at the last comparison
        self._next = 0.0
        side_m = mapper.map.voxel_size
        self._least = max(LEAST_VOXELS, round(LEAST_VOLUME_M3 / side_m**3))

    def look(self) -> list[SceneChanges]:
        """Compare the map with the one before if keyframes have come since; returns the update to send, if
        there is one. Raises TaichiMRFError."""
        m, begin = self._mapper.map, time.monotonic()
        if not has_dates(m) or begin < self._next:
            return []
        stamps = [keyframe.stamp_s for keyframe in m.keyframes.values()]
        if not stamps:
            return []
        before_s, self._compared_s = self._compared_s, max(stamps)
        self._next = math.inf  # if it fails, it is not tried again
        if before_s is None or self._compared_s <= before_s:
            self._next = 0.0
            return []
        before = m.layer(stamp_s=before_s)
        change = compare_maps(before, m, self._seen_since(before_s))
        change = without_slack(change, before, m, core=self._least)
        things = find_changed_things(change, m.voxel_size, self._least, max(REACH_M, m.voxel_size))
        seconds = time.monotonic() - begin
        self._next = begin + seconds / SHARE_OF_TIME
        for thing in reversed(things):
            size, centre = thing.size_m.tolist(), thing.centre_m.tolist()
            self._changes.appendleft(SceneChange(self._compared_s, thing.verb, tuple(size), tuple(centre)))
        return [self.listed()] if things else []

    def listed(self) -> SceneChanges:
        """The changes so far."""
        return SceneChanges(tuple(self._changes))

    def _seen_since(self, stamp_s: float) -> NDArray[np.int32]:
        """The bricks (n, 3) with voxels that rays of later keyframes cross. Elsewhere nothing has changed but
        that evidence has grown older."""
        m, pool = self._mapper.map, self._mapper.map.view.pool
        later = [id for id, keyframe in m.keyframes.items() if keyframe.stamp_s > stamp_s]
        crossed = np.concatenate([np.zeros((0, 3), np.int32), *map(m.crossed_bricks, later)])
        bricks = pool.bricks[pool.in_use]
        return bricks[np.isin(grid_keys(bricks), grid_keys(crossed))]
