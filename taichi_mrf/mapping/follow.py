"""Keyframes that follow poses which change while the map is made, as when a pose graph closes a loop.

Batch and live runs do the same: they look whether the source has other poses (datasets/pose_sources), and
then move the keyframes that these concern, for a limited time, until none is left.
"""

import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.pose_sources.posed import PosedFrames
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.capabilities import has_messages
from taichi_mrf.methods.protocol import OccupancyMap

BETWEEN_FRAMES_S = 0.2
"""Keyframes are moved for about this long, at most, between two frames (seconds)."""

FINAL_AFTER_S = 10.0
"""Poses are final once the recording is over and their file has not changed for this long (seconds)."""


@dataclass
class Followed:
    """Outcome of following poses in a run: ``changes`` of the source were read, and keyframes were moved
    ``moves`` times."""

    changes: int = 0
    moves: int = 0


class PoseFollower:
    """Moves the keyframes of one map to the present poses of their frames."""

    def __init__(
        self,
        m: OccupancyMap,
        dataset: PosedFrames,
        config: PoseConfig,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Raises ConfigError if the keyframes' poses are to be refined as well."""
        if config.refine:
            raise ConfigError("poses.refine and poses that follow a file both move keyframes: choose one")
        self.map, self.done = m, Followed()
        self._dataset, self._poses, self._clock = dataset, dataset.poses, clock
        self._left: dict[int, Pose] = {}
        self._changed_at = clock()
        self._said: set[str] = set()

    @property
    def name(self) -> str:
        """Name of the source in messages."""
        return self._poses.source.name

    @property
    def left(self) -> int:
        """Number of keyframes still to be moved."""
        return len(self._left)

    @property
    def quiet_s(self) -> float:
        """Seconds since the source has changed last."""
        return self._clock() - self._changed_at

    @property
    def is_final(self) -> bool:
        """True if the source has been unchanged for FINAL_AFTER_S and all keyframes have moved."""
        return not self._left and self.quiet_s >= FINAL_AFTER_S

    def look(self, stamp_s: float = math.inf) -> bool:
        """Ask the source, at a time of the recording in seconds; returns whether keyframes are to be moved.
        Raises DatasetError for an impossible pose."""
        if self._poses.renew(stamp_s):
            self.done.changes += 1
            self._changed_at = self._clock()
            self._left = self._elsewhere()
        return bool(self._left)

    def move(
        self, seconds: float | None = None, least: float | None = None, fixed: Collection[int] = ()
    ) -> tuple[int, ...]:
        """Move keyframes, in the order of ``update_poses``, for about ``seconds``; returns the ids of those
        that moved. Those that are ``fixed`` stay, and those that would move by less than ``least`` voxels, by
        default ``update_poses``' own.

        Raises CapacityError if there is not enough memory; the others are then left where they are.
        """
        wanted = {id: T for id, T in self._left.items() if id in self.map.keyframes and id not in fixed}
        self._left = {}
        if not wanted:
            return ()
        if has_messages(self.map):
            options: dict[str, Any] = {} if least is None else {"least": least}
            update = self.map.update_poses(wanted, **options, seconds=seconds)
            moved, self._left = update.moved, dict(update.left)
        else:
            for id, T in wanted.items():
                self.map.move_keyframe(id, T)
            moved = tuple(wanted)
        self.done.moves += len(moved)
        return moved

    def look_exactly(self) -> bool:
        """Look once more for keyframes that are not exactly at their frames' poses, because the way there was
        too short; returns whether there are any. With ``least`` 0, :meth:`move` moves them too."""
        self._left = self._elsewhere()
        return bool(self._left)

    def place_exactly(self) -> None:
        """Move all keyframes to exactly the poses of their frames. They have no evidence in the map until it
        is inferred. Raises CapacityError."""
        self.look_exactly()
        while self._left:
            id, T = self._left.popitem()
            self.map.move_keyframe(id, T)
            self.done.moves += 1

    def unnamed(self) -> str | None:
        """Note on keyframes that the source has never named; None if it names all."""
        keyframes = self.map.keyframes.values()
        count = sum(self._dataset.pose_now(each.name, each.stamp_s) is None for each in keyframes)
        if not count:
            return None
        of = f"{count} of {len(keyframes)} keyframes"
        return f"{of} have no pose in {self.name}, and stay where they were recorded"

    def news(self) -> list[str]:
        """News that a user was not told yet: a file that cannot be read, poses of unknown frames."""
        found = []
        if self._poses.source.problem is not None:
            found.append(f"{self._poses.source.problem}; the poses read before it stay")
        if self._poses.warning is not None:
            found.append(self._poses.warning)
        told = [text for text in found if text not in self._said]
        self._said = set(found)
        return told

    def _elsewhere(self) -> dict[int, Pose]:
        """The keyframes that are not at their frames' poses, by id, with these poses."""
        found = {}
        for id, keyframe in self.map.keyframes.items():
            T = self._dataset.pose_now(keyframe.name, keyframe.stamp_s)
            if T is not None and not np.array_equal(T, keyframe.T_world_camera):
                found[id] = T
        return found


def follower_of(m: OccupancyMap, dataset: Dataset | None, config: PoseConfig) -> PoseFollower | None:
    """Follower that moves the keyframes of a map with the poses of its recording, None if these do not
    change. Raises ConfigError as PoseFollower does."""
    if not isinstance(dataset, PosedFrames) or not dataset.follows:
        return None
    return PoseFollower(m, dataset, config)
