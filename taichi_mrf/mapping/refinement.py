"""Refining poses: each keyframe as it comes, and where all of them together fit best.

The first keyframe fixes the frame. A new one is aligned with the map so far (MRFMap.refine_pose). At the end
alignment/joint.py moves all of them at once (rounds.py), because alignment one after the other removes errors
only slowly that have added up on the way.
"""

from collections.abc import Collection, Generator, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from taichi_mrf.alignment.joint import LEVELS, TRACKED_LEVELS, align_jointly
from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.recorded import KnownPoses, RecordedPoses, TrackedSteps
from taichi_mrf.config.registry import methods_with
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.methods.capabilities import can_refine_poses
from taichi_mrf.methods.map_file import StoredKeyframe
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap


@dataclass(frozen=True)
class PoseChange:
    """Pose of a keyframe as it was recorded, and as it stands in the map."""

    keyframe: int
    name: str
    T_recorded: Pose
    T_refined: Pose

    @property
    def translation_m(self) -> float:
        """Metres by which it was moved."""
        return tangent_norms(self.T_recorded, self.T_refined)[1]

    @property
    def rotation_rad(self) -> float:
        """Radians by which it was turned."""
        return tangent_norms(self.T_recorded, self.T_refined)[0]


STEP_M, STEP_RAD = 0.03, 0.02
"""Standard deviations of tracked steps between keyframes. They count only where the depth of all keyframes
determines little: without them one of 298 keyframes along a corridor is left 15 cm off. As absolute sigmas
of tracked poses they leave a bend of 1.5 cm RMS in the built-in room instead of 0.6."""


class PoseRefiner:
    """Refines the keyframes of one map. If they were ``tracked``, there are no recorded poses to keep to, but
    the steps between them."""

    def __init__(self, m: MRFMap, config: PoseConfig, tracked: bool = False) -> None:
        self.map, self.config, self.tracked = m, config, tracked
        self._recorded: dict[int, Pose] = {}

    def note_recorded(self, keyframe: int, T_recorded: Pose) -> None:
        """Note the recorded pose of a keyframe that is placed already."""
        self._recorded[keyframe] = T_recorded

    def repeat(self, keyframes: Iterable[Keyframe | StoredKeyframe]) -> None:
        """Add keyframes at the poses to which an earlier run has refined them, and sweep each once, as that
        run did: the map that later keyframes are aligned with is the same, bit for bit."""
        for k in keyframes:
            parts = (k.depth_m, k.T_world_camera, k.camera, k.name, k.stamp_s, k.color)
            id = self.map.add_keyframe(*parts, **k.own.arguments())
            self.map.infer(keyframes=[id], sweeps=1)

    def drop_recorded(self, keyframe: int) -> None:
        """Drop the recorded pose of a keyframe that could not be placed."""
        self._recorded.pop(keyframe, None)

    def place(self, keyframe: int) -> None:
        """Align a new keyframe, which stands where it was recorded, with those before it; then sweep it once.

        Recorded poses may be wrong each by itself, or drift, in which case this keyframe has to be moved by
        about as much as the last one was. The search begins at the better of the two guesses.
        """
        T_recorded = self.map.keyframes[keyframe].T_world_camera
        placed = [id for id in self._recorded if id in self.map.keyframes]
        guesses = []
        if placed:
            last = max(placed)
            T_last = self.map.keyframes[last].T_world_camera
            guesses.append(T_last @ inverse(self._recorded[last]) @ T_recorded)
        if placed or self.map.frozen:
            self.map.refine_pose(keyframe, self.config, guesses)
        self._recorded[keyframe] = T_recorded
        self.map.infer(keyframes=[keyframe], sweeps=1)

    def joint(self, fixed: Collection[int] = ()) -> Generator[None, None, dict[int, Pose]]:
        """The poses, by id, at which all keyframes fit each other and their recorded poses best; nothing is
        moved. One that would go further than the configuration allows stays, as do those that are ``fixed``,
        and all that were tracked once some are frozen: these cannot follow.
        A generator: it yields for each pair of keyframes."""
        stood = {id: keyframe.T_world_camera for id, keyframe in self.map.keyframes.items()}
        if self.tracked and self.map.frozen:
            return stood
        levels = TRACKED_LEVELS if self.tracked else LEVELS
        found = yield from align_jointly(self._points(), stood, self._known(stood), fixed, levels)
        return {id: T if self._is_near(stood[id], T) else stood[id] for id, T in found.items()}

    def log_likelihood(self) -> Generator[None, None, float]:
        """Mean log-likelihood of the keyframes' depth, each in the map of the others, right after a sweep
        over all of them. A generator: it yields for each keyframe."""
        found = []
        for id in self.map.keyframes:
            yield
            found.append(self.map.depth_log_likelihood(id))
        return float(np.nanmean(found)) if found else float("nan")

    def changes(self) -> list[PoseChange]:
        """Recorded and present pose of every keyframe that was recorded."""
        keyframes = self.map.keyframes
        return [
            PoseChange(id, keyframe.name, self._recorded[id], keyframe.T_world_camera)
            for id, keyframe in keyframes.items()
            if id in self._recorded
        ]

    def _known(self, stood: Mapping[int, Pose]) -> KnownPoses:
        ids = sorted(stood)
        if self.tracked:
            return TrackedSteps([stood[id] for id in ids], STEP_M, STEP_RAD)
        return RecordedPoses([self._recorded[id] for id in ids], self.config)

    def _points(self) -> dict[int, OrientedPoints]:
        max_depth = self.map.sensor.max_depth
        return {id: oriented_points(k.image, max_depth) for id, k in self.map.keyframes.items()}

    def _is_near(self, T_now: Pose, T_world_camera: Pose) -> bool:
        rotation, translation = tangent_norms(T_now, T_world_camera)
        return rotation <= self.config.max_rotation and translation <= self.config.max_translation


def refiner_of(m: OccupancyMap, config: PoseConfig, tracked: bool = False) -> PoseRefiner | None:
    """A refiner for the poses of a map, ``tracked`` ones included; None if the configuration leaves them as
    they are. Raises ConfigError if the map's method cannot move keyframes."""
    if not (config.refine or (tracked and config.close_loops)):
        return None
    if not can_refine_poses(m):
        able = methods_with("can_refine_poses")
        raise ConfigError(f"poses.refine needs the method {able}; {m.METHOD.name} cannot align keyframes")
    return PoseRefiner(m, config, tracked and config.close_loops)
