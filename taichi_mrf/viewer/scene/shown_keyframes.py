"""The keyframes that the page knows: all that can be changed, the latest of the frozen ones, and of those
before only where they were and what they saw, so that an endless run needs no more and more memory."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.viewer.messages import KeyframeInfo

MOST_FROZEN = 50
MOST_WAYPOINTS = 2000


class ShownKeyframes:
    """Keyframes by number, and the camera's way through all there ever were."""

    def __init__(self) -> None:
        self.keyframes: dict[int, KeyframeInfo] = {}
        self.recorded: dict[int, Pose] = {}
        """Where each keyframe was before anybody moved it."""
        self._old_way: list[NDArray[np.float64]] = []
        self._old_crossed = np.zeros((0, 3), np.int32)
        self._every, self._forgotten = 1, 0

    def put(self, keyframe: KeyframeInfo) -> list[int]:
        """Remember a keyframe that is new or has changed; returns the numbers of those that are forgotten."""
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
        """The camera's way, (n, 3), oldest first; where it is long, only every so many-th of its points."""
        known = [self.keyframes[id].T_world_camera[:3, 3] for id in sorted(self.keyframes)]
        return np.array([*self._old_way, *known]).reshape(-1, 3)

    def crossed(self) -> list[NDArray[np.int32]]:
        """Bricks (n, 3) that the rays of keyframes went through, except those that are off."""
        seen = [keyframe.crossed for keyframe in self.keyframes.values() if keyframe.state != "off"]
        return [self._old_crossed, *seen]

    def _forget(self, id: int) -> None:
        keyframe = self.keyframes.pop(id)
        del self.recorded[id]
        together = np.concatenate([self._old_crossed, keyframe.crossed])
        self._old_crossed = np.unique(together, axis=0).astype(np.int32)
        if self._forgotten % self._every == 0:
            self._old_way.append(keyframe.T_world_camera[:3, 3])
        self._forgotten += 1
        if len(self._old_way) > MOST_WAYPOINTS:
            self._old_way = self._old_way[::2]
            self._every *= 2
