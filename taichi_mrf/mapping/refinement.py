"""Refining the poses of a whole sequence: each keyframe as it comes, then all of them together.

The first keyframe fixes the frame. A new one is aligned by MRFMap.refine_pose with the map so far. At the end
alignment/joint.py moves all of them at once, because one after the other they would only slowly take out
what has added up on the way.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from taichi_mrf.alignment.joint import align_jointly
from taichi_mrf.alignment.likelihood import log_likelihood, map_of_others
from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import MappedKeyframe, OccupancyMap

LOSS = 0.1
"""Log-likelihood per pixel that a round may cost. One after the other keyframes fit each other a little
better than all together, who heed where they were recorded; if they do not fit, more is lost by far."""

SETTLED = 0.02
"""Share of a voxel: rounds end when no keyframe was moved further."""


@dataclass(frozen=True)
class PoseChange:
    """Where a keyframe was recorded, and where it stands in the map."""

    keyframe: int
    name: str
    T_recorded: Pose
    T_refined: Pose

    @property
    def translation_m(self) -> float:
        """How far it was moved."""
        return tangent_norms(self.T_recorded, self.T_refined)[1]

    @property
    def rotation_rad(self) -> float:
        """How far it was turned."""
        return tangent_norms(self.T_recorded, self.T_refined)[0]


class PoseRefiner:
    """Refines the keyframes of one map."""

    def __init__(self, m: MRFMap, config: PoseConfig) -> None:
        self._map, self.config = m, config
        self._recorded: dict[int, Pose] = {}

    def know(self, keyframe: int, T_recorded: Pose) -> None:
        """Take note of where a keyframe was recorded that is placed already."""
        self._recorded[keyframe] = T_recorded

    def repeat(self, keyframes: Iterable[MappedKeyframe]) -> None:
        """Place keyframes that an earlier run has refined where it left them, and let each speak as it did
        then: what is known to those after them is what it was, to the last bit."""
        for k in keyframes:
            id = self._map.add_keyframe(k.depth_m, k.T_world_camera, k.camera, k.name)
            self._map.infer(keyframes=[id], sweeps=1)

    def forget(self, keyframe: int) -> None:
        """Take out a keyframe that could not be placed."""
        self._recorded.pop(keyframe, None)
        self._map.remove_keyframe(keyframe)

    def place(self, keyframe: int) -> None:
        """Align a new keyframe, which stands where it was recorded, with those before it; then let it speak.

        Recorded poses may be wrong each by itself, or drift, in which case the last keyframe was moved by
        about as much as this one has to be. The search begins at the better of the two.
        """
        T_recorded = self._map.keyframes[keyframe].T_world_camera
        placed = [id for id in self._recorded if id in self._map.keyframes]
        guesses = []
        if placed:
            last = max(placed)
            T_last = self._map.keyframes[last].T_world_camera
            guesses.append(T_last @ inverse(self._recorded[last]) @ T_recorded)
        if placed or self._map.frozen:
            self._map.refine_pose(keyframe, self.config, guesses)
        self._recorded[keyframe] = T_recorded
        self._map.infer(keyframes=[keyframe], sweeps=1)

    def rounds(self, on_keyframe: Callable[[int, int, int], bool]) -> None:
        """Align all keyframes with each other and with where they were recorded, until they stay where they
        are or the configuration's rounds are over. A round that makes their depth less likely is undone.

        ``on_keyframe`` is told, after each, the round, the keyframe's number in it (both from 1) and how many
        there are; by returning False it ends the rounds, of which this one is undone. The marginals are to
        be inferred again afterwards.
        """
        before = self._inferred_log_likelihood()
        for round in range(1, self.config.rounds + 1):
            stood = {id: keyframe.T_world_camera for id, keyframe in self._map.keyframes.items()}
            for number, (id, T_world_camera) in enumerate(self.joint().items(), start=1):
                self._move(id, T_world_camera)
                if not on_keyframe(round, number, len(stood)):
                    self._undo(stood)
                    return
            if has_settled(self._map, stood):
                return
            after = self._inferred_log_likelihood()
            if is_worse(before, after):
                self._undo(stood)
                return
            before = after

    def joint(
        self, fixed: Collection[int] = (), on_pair: Callable[[], None] = lambda: None
    ) -> dict[int, Pose]:
        """Where all keyframes, by id, fit each other and where they were recorded; nothing is moved here. One
        that would go further than allowed stays, as do those that are ``fixed``. What ``on_pair`` raises ends
        the search."""
        stood = {id: keyframe.T_world_camera for id, keyframe in self._map.keyframes.items()}
        found = align_jointly(self._points(), stood, self._recorded, self.config, fixed, on_pair)
        return {id: T if self._is_near(stood[id], T) else stood[id] for id, T in found.items()}

    def log_likelihood(self, on_keyframe: Callable[[], None] = lambda: None) -> float:
        """Mean log-likelihood of the keyframes' depth, each in the map of the others, right after a sweep
        over all of them."""
        view, max_depth = self._map.view, self._map.sensor.max_depth
        found = []
        for keyframe in self._map.keyframes.values():
            on_keyframe()
            with map_of_others(view, keyframe):
                found.append(log_likelihood(view, keyframe, keyframe.T_world_camera, max_depth))
        return float(np.nanmean(found)) if found else float("nan")

    def changes(self) -> list[PoseChange]:
        """What became of every keyframe."""
        keyframes = self._map.keyframes
        return [
            PoseChange(id, keyframe.name, self._recorded[id], keyframe.T_world_camera)
            for id, keyframe in keyframes.items()
        ]

    def _points(self) -> dict[int, OrientedPoints]:
        max_depth = self._map.sensor.max_depth
        return {id: oriented_points(k.image, max_depth) for id, k in self._map.keyframes.items()}

    def _undo(self, stood: Mapping[int, Pose]) -> None:
        for id, T_world_camera in stood.items():
            self._move(id, T_world_camera)

    def _move(self, id: int, T_world_camera: Pose) -> None:
        if not np.array_equal(self._map.keyframes[id].T_world_camera, T_world_camera):
            self._map.move_keyframe(id, T_world_camera)

    def _is_near(self, T_now: Pose, T_world_camera: Pose) -> bool:
        rotation, translation = tangent_norms(T_now, T_world_camera)
        return rotation <= self.config.max_rotation and translation <= self.config.max_translation

    def _inferred_log_likelihood(self) -> float:
        self._map.infer(sweeps=1)
        return self.log_likelihood()


def refiner_of(m: OccupancyMap, config: PoseConfig) -> PoseRefiner | None:
    """What refines the poses of a map, None if they are to stay. Raises ConfigError if the map's method
    cannot move keyframes."""
    if not config.refine:
        return None
    if not isinstance(m, MRFMap):
        method = m.config.method
        raise ConfigError(f"poses.refine needs the method mrf; a map by {method} cannot move keyframes")
    return PoseRefiner(m, config)


def has_settled(m: MRFMap, stood: Mapping[int, Pose]) -> bool:
    """Whether no keyframe has moved far from where it stood."""
    keyframes = m.keyframes
    moved_m = [tangent_norms(T, keyframes[id].T_world_camera)[1] for id, T in stood.items()]
    return max(moved_m, default=0.0) < SETTLED * m.voxel_size


def is_worse(before: float, after: float) -> bool:
    """Whether a round made the depth less likely by more than it may."""
    return not after > before - LOSS
