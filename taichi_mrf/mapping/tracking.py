"""Tracking a camera without poses: each frame is aligned with the map of the frames before it.

The first frame fixes the map's frame. Each later one is aligned with what the keyframes have measured
(alignment/locate.py), from where corners of the image before are seen now (alignment/optical_flow.py).
Without colour, or where that fits nothing, there are two guesses: that the camera stands still, and that it
moves on as it did. Both have turned as the gyroscope says, where there is one (turning.py); an accelerometer
adds a third guess (momentum.py). If none fits, the scan of a sensor that sees around is searched for in all
headings and metres around. A frame that fits nowhere is lost; the next one is searched around the last pose
that was found, around the first, and around those of keyframes that look like it. A place where a lost camera
fits has to be confirmed by the frames that follow. Errors of alignment add up along the way, until a loop is
closed (loops.py). Poses are kept relative to the keyframe of the moment, so that they follow if that moves.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.appearance import Appearances, Picture, small_picture
from taichi_mrf.alignment.keyframe_pictures import ColorLevel, KeyframePictures
from taichi_mrf.alignment.locate import Located, Locator
from taichi_mrf.alignment.optical_flow import motion_between
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.se3 import moved, twist
from taichi_mrf.alignment.wide_search import Around
from taichi_mrf.config.registry import methods_with
from taichi_mrf.config.schema import Config, KeyframeConfig, PoseConfig
from taichi_mrf.datasets.entries import REALSENSE
from taichi_mrf.datasets.options import TRACK
from taichi_mrf.errors import ConfigError, LostFrameError
from taichi_mrf.geometry.poses import Pose, as_pose, inverse, tangent_norms
from taichi_mrf.inference.keyframe import DepthImage, checked_depth
from taichi_mrf.mapping.momentum import Momentum
from taichi_mrf.mapping.turning import GyroTurns, turned
from taichi_mrf.methods.capabilities import can_refine_poses
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import Camera, sees_around
from taichi_mrf.sensor.frame import Frame

STEPS = KeyframeConfig(rotation=RULES.keyframe_rad, translation=RULES.keyframe_m)
"""The steps between keyframes if the configuration sets none."""


@dataclass(frozen=True)
class TrackedFrame:
    """The pose of a frame: relative to the last keyframe at that time, and in the world as it was then.
    ``directions``: how many of the six degrees of freedom its points determine. If the frame became a
    keyframe itself, ``before`` is what it was until then: relative to the keyframe before it."""

    name: str
    stamp: float
    T_world_camera: Pose
    keyframe: int | None
    T_keyframe_camera: Pose
    directions: int
    before: "TrackedFrame | None" = None

    def pose_in(self, m: OccupancyMap) -> Pose:
        """(4, 4) in the present world frame; the original pose if its keyframe was removed or frozen."""
        if self.keyframe is None or self.keyframe not in m.keyframes:
            return self.T_world_camera
        return m.keyframes[self.keyframe].T_world_camera @ self.T_keyframe_camera


@dataclass
class Track:
    """The poses of a sequence's frames by dataset index, and how many frames were lost. ``found_again`` has
    each frame at which a lost camera was found, with the number of frames that were lost before it."""

    frames: dict[int, TrackedFrame] = field(default_factory=dict)
    lost: int = 0
    found_again: dict[str, int] = field(default_factory=dict)

    @property
    def unsure(self) -> int:
        """Frames whose points do not determine all six degrees of freedom; the rest is the guess."""
        return sum(frame.directions < 6 for frame in self.frames.values())

    def poses(self, m: OccupancyMap) -> dict[int, Pose]:
        """The pose of each frame, (4, 4), in the present world frame. If the keyframes before and after a
        frame have moved against each other, it takes a share of that."""
        poses = {index: frame.pose_in(m) for index, frame in self.frames.items()}
        passed: list[int] = []  # the frames since the last keyframe
        for index, frame in self.frames.items():
            if frame.before is None:
                passed.append(index)
                continue
            drift = twist(inverse(frame.before.pose_in(m)) @ poses[index])
            for n, between in enumerate(passed, start=1):
                if self.frames[between].keyframe == frame.before.keyframe:
                    poses[between] = moved(poses[between], n / (len(passed) + 1) * drift)
            passed.clear()
        return poses

    def trajectory(self, m: OccupancyMap) -> list[tuple[float, Pose]]:
        """Poses of the track with their stamps, in the order in which the frames came."""
        return [(self.frames[index].stamp, T) for index, T in self.poses(m).items()]


class Tracker:
    """Follows the camera through one map. It does not add keyframes itself."""

    def __init__(self, m: MRFMap, config: PoseConfig) -> None:
        self.map = m
        self._config = replace(
            config,
            translation_sigma=RULES.guess_m,
            rotation_sigma=RULES.guess_rad,
            max_translation=RULES.reach_m,
            max_rotation=RULES.reach_rad,
        )
        self._locator = Locator(m.aligner.surface)
        self._gyro_config = replace(self._config, rotation_sigma=RULES.gyro_rad)
        self._turns = GyroTurns()
        self._momentum = Momentum()
        self._pictures = KeyframePictures()
        self.appearances = Appearances()
        self._frame: Frame | None = None
        self._keyframe: int | None = None
        self._first: TrackedFrame | None = None
        self._before: TrackedFrame | None = None
        self._last: TrackedFrame | None = None
        self._lost = 0
        self._again: list[Pose] = []

    @property
    def lost(self) -> int:
        """Number of frames lost since the last that was not."""
        return self._lost

    def follow(self, frame: Frame) -> tuple[Frame, TrackedFrame]:
        """The frame at the pose that was found for it. Only the first frame's own pose counts.

        Raises LostFrameError, which names the frame.
        """
        m = self.map
        if self._last is None or not (m.keyframes or m.frozen):
            return self._found(
                frame, frame.T_world_camera if self._last is None else self._pose(self._last), 6
            )
        depth_m = checked_depth(frame.depth_m, frame.camera, m.sensor.min_depth)
        image = DepthImage.upload(depth_m, frame.camera, m.noise, own=frame.own_for(m.sensor))
        around = self._around(frame.camera, frame.stamp) if sees_around(frame.camera) else None
        turn = self._turns.since(frame, self._last.stamp)
        guesses = turned(self._guesses(frame), self._pose(self._last), turn)
        if around is None and self._lost:
            guesses += [*self._again[-1:], *self._known_places(small_picture(depth_m, frame.color))]
        config = self._config if turn is None or self._lost else self._gyro_config
        colors = partial(self._pictures.compared_with, frame, m.keyframes)
        located = self._from_flow(image, frame, config, colors)
        if located is None or located.T_world_camera is None:
            located = self._locator.locate(image, guesses, m.keyframes, config, around, colors)
        T_world_camera, reason = located.T_world_camera, located.reason
        if T_world_camera is not None and around is None:
            reason = self._objection(located.overlap, self._locator.looked_through(image, T_world_camera))
        if T_world_camera is None or reason:
            self._again = []
        elif around is None:
            reason = self._unconfirmed(T_world_camera, located.overlap)
        if T_world_camera is None or reason:
            self._lost += 1
            raise LostFrameError(f"{frame.name}: tracking lost: {reason}")
        if located.directions == 6:
            self._turns.note(frame, self._last.stamp, self._pose(self._last), T_world_camera)
            self._momentum.note(frame, T_world_camera)
        if self._lost:
            self._last = None  # the motion since then is unknown
        return self._found(frame, T_world_camera, located.directions)

    def _objection(self, overlap: float, through: float) -> str:
        """Reason to doubt that a camera is where its image fits, with these shares near what is mapped and
        looking through it; empty if it is. The longer it was lost, the further it may be from there."""
        sure = not self._lost and overlap >= RULES.loop_overlap
        least, most = 0.0, RULES.most_through if sure else RULES.lost_through
        if self._lost > RULES.long_lost:
            least, most = RULES.strict_overlap, RULES.strict_through
        if through > most:
            return f"it would look through {100 * through:.1f}% of the mapped surface"
        if overlap < least:
            near, needed = 100 * overlap, 100 * least
            return f"{near:.0f}% of its points lie near mapped surfaces, but {needed:.0f}% are needed"
        return ""

    def _unconfirmed(self, T_world_camera: Pose, overlap: float) -> str:
        """Reason to wait before a lost camera is believed to be where its image fits; empty if the images
        before it fitted near there as well, or if it was lost for a moment only and has hardly moved. All of
        them are held against the map as it was when the camera was lost: an image that fits by chance, once
        it is in the map, would explain those after it."""
        assert self._last is not None
        hardly = self._lost < RULES.relocated and overlap >= RULES.loop_overlap
        if not self._lost or (hardly and _within_reach(self._pose(self._last), T_world_camera)):
            return ""
        near = self._again and _within_reach(self._again[-1], T_world_camera)
        self._again = [*self._again, T_world_camera] if near else [T_world_camera]
        missing = RULES.relocated - len(self._again)
        return f"it fits a place that {missing} more frames must confirm" if missing else ""

    def took(self, keyframe: int) -> TrackedFrame:
        """Note that the frame that was followed last has become this keyframe of the map, and may have been
        moved a little; returns its pose."""
        assert self._last is not None
        T_world_camera, before = self.map.keyframes[keyframe].T_world_camera, self._last
        self._keyframe = keyframe
        if self._frame is not None:
            self._pictures.keep(keyframe, self._frame)
        color = None if self._frame is None else self._frame.color
        self._note_appearance(keyframe, color)
        self._last = replace(
            self._tracked(before.name, before.stamp, T_world_camera, before.directions), before=before
        )
        self._first = self._first or self._last
        return self._last

    def resume(self, keyframe: int) -> None:
        """Go on from a keyframe that was mapped in an earlier run."""
        keyframes = self.map.keyframes
        self._keyframe = keyframe
        self._last = self._tracked(keyframes[keyframe].name, math.nan, keyframes[keyframe].T_world_camera, 6)
        self._first = self._first or self._last
        self._note_appearance(keyframe, keyframes[keyframe].color)

    def _note_appearance(self, keyframe: int, color: NDArray[np.uint8] | None) -> None:
        self.appearances.add(keyframe, small_picture(self.map.keyframes[keyframe].depth_m, color))

    def _found(self, frame: Frame, T_world_camera: Pose, directions: int) -> tuple[Frame, TrackedFrame]:
        T_world_camera = as_pose(T_world_camera)  # or rounding errors would add up over the frames
        tracked = self._tracked(frame.name, frame.stamp, T_world_camera, directions)
        self._before, self._last, self._lost, self._frame = self._last, tracked, 0, frame
        self._again = []
        return replace(frame, T_world_camera=T_world_camera), tracked

    def _tracked(self, name: str, stamp: float, T_world_camera: Pose, directions: int) -> TrackedFrame:
        keyframe = self._keyframe if self._keyframe in self.map.keyframes else None
        T_keyframe_camera = T_world_camera
        if keyframe is not None:
            T_keyframe_camera = inverse(self.map.keyframes[keyframe].T_world_camera) @ T_world_camera
        return TrackedFrame(name, stamp, T_world_camera, keyframe, T_keyframe_camera, directions)

    def _pose(self, tracked: TrackedFrame) -> Pose:
        return tracked.pose_in(self.map)

    def _ahead(self, stamp: float) -> float | None:
        """For how many times as long as it was observed the last motion is continued, if it is."""
        if self._last is None or self._before is None:
            return None
        ahead = _ratio(stamp - self._last.stamp, self._last.stamp - self._before.stamp)
        return ahead if ahead <= RULES.longest_ahead else None

    def _around(self, camera: Camera, stamp: float) -> Around:
        """Space in which a sensor that sees around may be by now."""
        assert self._last is not None
        reach_m = min(RULES.around_m + RULES.around_lost_m * self._lost, RULES.most_around_m)
        T_last = self._pose(self._last)
        expected_m = T_last[:3, 3]
        ahead = self._ahead(stamp)
        if self._before is not None and ahead is not None:
            expected_m = expected_m + ahead * (expected_m - self._pose(self._before)[:3, 3])
        return Around(T_last, camera.up, reach_m, expected_m, RULES.expected_m * (1 + self._lost))

    def _guesses(self, frame: Frame) -> list[Pose]:
        """Poses of the camera if it stands still, by its accelerometer, and if it moves on, which is left out
        while the accelerometer is right."""
        assert self._last is not None
        T_last = self._pose(self._last)
        guesses = [T_last, *(carried := self._carried(frame))]
        ahead = self._ahead(frame.stamp)
        if carried and self._momentum.proven and not self._lost:
            return guesses
        if self._before is not None and ahead is not None:
            step = twist(inverse(self._pose(self._before)) @ T_last)
            guesses.append(moved(T_last, ahead * step))
        return guesses

    def _from_flow(
        self,
        image: DepthImage,
        frame: Frame,
        config: PoseConfig,
        colors: Callable[[Pose], Sequence[ColorLevel]] | None,
    ) -> Located | None:
        """The frame's place near where corners of the last image are seen now; None if that is not known."""
        if self._frame is None or self._last is None or self._lost or colors is None:
            return None
        motion = motion_between(self._frame, frame)
        if motion is None:
            return None
        guess = [self._pose(self._last) @ motion]
        keyframes = self.map.keyframes
        return self._locator.locate(
            image, guess, keyframes, config, colors=colors, observable=RULES.observable_by_depth
        )

    def _carried(self, frame: Frame) -> list[Pose]:
        """Pose of the camera by its accelerometer, if that tells."""
        if self._last is None or self._before is None:
            return []
        before, last = ((tracked.stamp, self._pose(tracked)) for tracked in (self._before, self._last))
        T_world_camera = self._momentum.ahead(frame, before, last, self._turns.bias_rad_s)
        return [] if T_world_camera is None else [T_world_camera]

    def _known_places(self, picture: Picture) -> list[Pose]:
        """Poses of a lost camera: where it began, and where keyframes look like its picture."""
        keyframes = self.map.keyframes
        likeness = self.appearances.likeness(picture)
        known = [id for id, how in likeness.items() if how > RULES.alike and id in keyframes]
        best = sorted(known, key=lambda id: -likeness[id])[: RULES.known_places]
        first = [] if self._first is None else [self._pose(self._first)]
        return [*first, *(keyframes[id].T_world_camera for id in best)]


def _within_reach(one: Pose, other: Pose) -> bool:
    """True if a camera may go from the one pose (4, 4) to the other between two images."""
    turned_rad, shifted_m = tangent_norms(one, other)
    return turned_rad <= RULES.reach_rad and shifted_m <= RULES.reach_m


def _ratio(ahead: float, observed: float) -> float:
    """Ratio of two times; 1 where stamps do not tell."""
    told = math.isfinite(ahead) and math.isfinite(observed) and ahead > 0 and observed > 0
    return ahead / observed if told else 1.0


def tracker_of(m: OccupancyMap, config: PoseConfig) -> Tracker:
    """A tracker for a map. Raises ConfigError if the map's method cannot be tracked in."""
    if not can_refine_poses(m):
        raise ConfigError(
            f"tracking needs the method {methods_with('can_refine_poses')}, not {m.METHOD.name}"
        )
    return Tracker(m, config)


def keyframe_steps(config: KeyframeConfig) -> KeyframeConfig:
    """The steps between keyframes of a tracked camera: the configuration's, or STEPS if it sets none."""
    if config.rotation == 0 and config.translation == 0:
        return replace(config, rotation=STEPS.rotation, translation=STEPS.translation)
    return config


def wants_color(config: Config, source: str, track: bool) -> bool:
    """True if the colour images of a source are to be read: for the map, or to ``track`` the camera."""
    tracked = track or f"poses={TRACK}" in source or (source.startswith(REALSENSE) and "poses=" not in source)
    return config.color or tracked
