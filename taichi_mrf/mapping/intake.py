"""The way from a frame to a keyframe: hold-out, tracking, selection, adding, alignment on arrival.

Batch runs, live runs and trials of parameters offer their frames here one by one and get a typed answer; what
follows from it (a progress bar, a notice, the end of the run) is up to them.
"""

import warnings
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from taichi_mrf.alignment.locate_recording import PlaceCheck
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import CapacityError, LostFrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.mapping.loops import Closure, loop_closer_of
from taichi_mrf.mapping.refinement import refiner_of
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.mapping.selection import KeyframeSelector, is_held_out
from taichi_mrf.mapping.tracking import Track, keyframe_steps, tracker_of
from taichi_mrf.methods.capabilities import can_refine_poses
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.frame import Frame


@dataclass(frozen=True)
class UnreadableFrame:
    """A frame that could not be read. ``last``: nor can any after it, as with a camera that was unplugged."""

    name: str
    problem: str
    last: bool = False


@dataclass(frozen=True)
class Added:
    """The frame, at the pose that was found for it, is keyframe ``keyframe`` of the map, with ``rays``
    measured pixels. Its marginals are not inferred yet, unless the intake sweeps or aligns it. ``closure`` is
    the loop that it closes, which has moved other keyframes. ``doubt`` says why the recording may not be
    where it was located in an earlier map, if that shows with this keyframe."""

    frame: Frame
    keyframe: int
    rays: int
    closure: Closure | None = None
    doubt: str = ""


@dataclass(frozen=True)
class Passed:
    """The frame is no keyframe, for ``reason``; ``frame`` has its pose, if the frame was read."""

    reason: str
    frame: Frame | None = None


@dataclass(frozen=True)
class Lost:
    """Tracking found no pose for the frame, nor for those before it: ``in_a_row`` frames in all."""

    problem: str
    in_a_row: int


@dataclass(frozen=True)
class Skipped:
    """The frame could not be read."""

    problem: str


@dataclass(frozen=True)
class Full:
    """There is not enough memory for the frame. The map is what it was before; ``error`` is what it
    raised."""

    problem: str
    error: CapacityError


Answer = Added | Passed | Lost | Skipped | Full

HELD_OUT = Passed("held out to check the map")


class Intake:
    """Takes frames into one map; :attr:`result` is the record of the run."""

    def __init__(
        self,
        m: OccupancyMap,
        config: Config,
        *,
        tracked: bool = False,
        hold_out: int = 0,
        sweep: Callable[[int], None] | None = None,
        remember_frames: bool = True,
        before_adding: Callable[[Frame], None] = lambda frame: None,
        fixed: Callable[[], Collection[int]] = lambda: (),
        place: PlaceCheck | None = None,
    ) -> None:
        """``tracked``: the poses of frames are found by tracking. ``hold_out``: one frame in so many is held
        out. ``sweep`` is called with each new keyframe that is not aligned, which is swept anyway, so that
        the map can be looked at. ``remember_frames``: the result lists skipped frames and tracked poses,
        which grow with the run. ``before_adding`` is called with each frame that is about to be added.
        ``fixed`` returns the ids of keyframes that no closed loop may move. ``place`` checks where the frames
        were located in an earlier map.
        Raises ConfigError if poses are to be refined or tracked in a map whose method cannot."""
        self.map = m
        self.result = MappingResult(m)
        self.tracker = tracker_of(m, config.poses) if tracked else None
        self.refiner = refiner_of(m, config.poses, tracked)
        self._loops, self._place = loop_closer_of(self.tracker, config.poses, fixed), place
        self._aligns = config.poses.refine
        if self.tracker is not None:
            self.result.track = Track()
        self._selector = KeyframeSelector(keyframe_steps(config.keyframes) if tracked else config.keyframes)
        self._hold_out, self._sweep = hold_out, sweep
        self._remembers, self._before_adding = remember_frames, before_adding
        self._expects_color = True  # until a frame without colour was named
        self._expects_no_return = self.map.sensor.no_return != "ignore"  # until one that names no such pixels

    def passes_unread(self, number: int, index: int) -> bool:
        """True if the ``number``-th frame (from 1) is held out without being read, which the result notes by
        its dataset ``index``. Frames whose poses are tracked are all read."""
        held_out = self.tracker is None and is_held_out(number, self._hold_out)
        if held_out:
            self.result.held_out.append(index)
        return held_out

    def offer(self, frame: Frame | UnreadableFrame, number: int = 0, index: int = 0) -> Answer:
        """Take the next frame, the ``number``-th (from 1) of its run, ``index`` in its dataset.

        Raises what the map raises but for CapacityError; the map is then what it was before.
        """
        if isinstance(frame, UnreadableFrame):
            self._note_skipped(frame.name, frame.problem)
            return Skipped(frame.problem)
        if self.tracker is not None:
            located = self._located(frame, index)
            if isinstance(located, Lost):
                return located
            frame = located
            if is_held_out(number, self._hold_out):
                self.result.held_out.append(index)
                return Passed(HELD_OUT.reason, frame)
        tells = frame.tells_anything(self.map.sensor)
        objection = self._selector.objection(frame.T_world_camera, tells, frame.sensor)
        if objection is not None:
            return Passed(objection, frame)
        self._before_adding(frame)
        try:
            keyframe = self._added(frame)
        except CapacityError as error:
            return Full(f"frame {frame.name} does not fit: {error}", error)
        closure = None
        if self.tracker is not None:
            tracked = self.tracker.took(keyframe)
            if self._remembers and self.result.track is not None:
                self.result.track.frames[index] = tracked
            closure = self._close_loops(keyframe)
            frame = replace(frame, T_world_camera=self.map.keyframes[keyframe].T_world_camera)
        self._selector.accept(frame.T_world_camera, frame.sensor)
        doubt = ""
        if self._place is not None and can_refine_poses(self.map):
            doubt = self._place.take(self.map.keyframes[keyframe].image, frame.T_world_camera)
            self.result.doubt = self.result.doubt or doubt
        return Added(frame, keyframe, self.map.keyframes[keyframe].rays, closure, doubt)

    def go_on_from(self, keyframe: int, T_recorded: Pose, sensor: str = "") -> None:
        """Go on after a keyframe of a sensor that the map of an earlier run has brought along."""
        T_world_camera = self.map.keyframes[keyframe].T_world_camera
        if self.tracker is not None:
            self.tracker.resume(keyframe)
            self._close_loops(keyframe)
        if self.refiner is not None and self._aligns:
            T_world_camera = T_recorded
            self.refiner.note_recorded(keyframe, T_recorded)
        self._selector.accept(T_world_camera, sensor)

    def _located(self, frame: Frame, index: int) -> Frame | Lost:
        """The frame at the pose where it was taken."""
        assert self.tracker is not None
        assert self.result.track is not None
        track, lost_before = self.result.track, self.tracker.lost
        with self.result.timed("tracking"):
            try:
                found, tracked = self.tracker.follow(frame)
            except LostFrameError as error:
                track.lost += 1
                self._note_skipped(frame.name, str(error))
                return Lost(str(error), self.tracker.lost)
        if lost_before:
            track.found_again[frame.name] = lost_before
        if self._remembers:
            track.frames[index] = tracked
        return found

    def _added(self, frame: Frame) -> int:
        """Add a frame as a keyframe and align it, or leave nothing of it; returns its number."""
        with self.result.timed("adding"):
            if not self.map.config.color:
                frame = replace(frame, color=None)
            elif frame.color is None and self._expects_color:
                self._expects_color = False
                warnings.warn(f"frame {frame.name} has no colour image", stacklevel=2)
            if self._expects_no_return and frame.no_return is None:
                self._expects_no_return = False
                warnings.warn(
                    f"frame {frame.name} does not mark pixels without a return: sensor.no_return "
                    f'"{self.map.sensor.no_return}" has no effect on it',
                    stacklevel=2,
                )
            keyframe = self.map.add(frame)
        try:
            if self.refiner is not None and self._aligns:
                with self.result.timed("refining"):
                    self.refiner.place(keyframe)
            elif self._sweep is not None:
                with self.result.timed("inferring"):
                    self._sweep(keyframe)
        except BaseException:
            if self.refiner is not None:
                self.refiner.drop_recorded(keyframe)
            self.map.remove_keyframe(keyframe)
            raise
        return keyframe

    def _close_loops(self, keyframe: int) -> Closure | None:
        """Enter a keyframe into the pose graph, which may move others."""
        if self._loops is None:
            return None
        with self.result.timed("closing loops"):
            try:
                closure = self._loops.took(keyframe)
            except CapacityError as error:
                warnings.warn(f"a loop was not closed: {error}", stacklevel=2)
                return None
        if closure is not None:
            self.result.loops_closed += 1
        return closure

    def _note_skipped(self, name: str, problem: str) -> None:
        if self._remembers:
            self.result.skipped[name] = problem


def hold_out_of(dataset: Dataset, config: Config) -> int:
    """One frame in so many of a dataset is held out; 0 for none. The images of a camera or a robot cannot be
    read again: nothing could be checked against them."""
    return 0 if dataset.endless else config.evaluation.hold_out
