"""The keyframes that the page keeps: all that can be changed, and the latest frozen ones. Of older frozen
keyframes only positions and crossed bricks are kept, so that the memory of an endless run stays bounded."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.viewer.messages import KeyframeInfo

MOST_FROZEN = 50
MOST_WAYPOINTS = 2000
LEAST_TO_MERGE = 4096
"""From this number on, the bricks that dropped keyframes crossed are merged."""


class ShownKeyframes:
    """Keyframes by number, and the camera's path through all of them, dropped ones included."""

    def __init__(self) -> None:
        self.keyframes: dict[int, KeyframeInfo] = {}
        self.recorded: dict[int, Pose] = {}
        """The pose of each keyframe that *Put back* restores."""
        self._old_way: list[NDArray[np.float64]] = []
        self._old_crossed: list[NDArray[np.int32]] = []
        self._merged = 0
        self._every, self._forgotten = 1, 0

    def put(self, keyframe: KeyframeInfo) -> list[int]:
        """Keep a keyframe that is new or has changed; returns the numbers of keyframes that are forgotten for
        it."""
        self.keyframes[keyframe.id] = keyframe
        home = keyframe.T_home
        if home is not None:
            self.recorded[keyframe.id] = home
        else:
            self.recorded.setdefault(keyframe.id, keyframe.T_world_camera)
        frozen = [id for id in sorted(self.keyframes) if self.keyframes[id].state == "frozen"]
        forgotten = frozen[: max(0, len(frozen) - MOST_FROZEN)]
        for id in forgotten:
            self._forget(id)
        return forgotten

    def way_m(self) -> NDArray[np.float64]:
        """The camera's path, (n, 3) in metres, world, oldest first; a long path is thinned out."""
        known = [self.keyframes[id].T_world_camera[:3, 3] for id in sorted(self.keyframes)]
        return np.array([*self._old_way, *known]).reshape(-1, 3)

    def crossed(self) -> list[NDArray[np.int32]]:
        """Bricks (n, 3) that rays of keyframes cross; keyframes that are off are left out."""
        seen = [keyframe.crossed for keyframe in self.keyframes.values() if keyframe.state != "off"]
        return [*self._old_crossed, *seen]

    def _forget(self, id: int) -> None:
        keyframe = self.keyframes.pop(id)
        del self.recorded[id]
        self._old_crossed.append(keyframe.crossed)
        # Merged only when they have doubled, so that each brick is sorted a few times at most.
        if sum(map(len, self._old_crossed)) > max(2 * self._merged, LEAST_TO_MERGE):
            self._old_crossed = [np.unique(np.concatenate(self._old_crossed), axis=0).astype(np.int32)]
            self._merged = len(self._old_crossed[0])
        if self._forgotten % self._every == 0:
            self._old_way.append(keyframe.T_world_camera[:3, 3])
        self._forgotten += 1
        if len(self._old_way) > MOST_WAYPOINTS:
            self._old_way = self._old_way[::2]
            self._every *= 2
