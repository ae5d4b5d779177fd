"""Frames -> keyframes -> map -> events: how a sequence becomes a map.

Whoever wants to watch (a progress bar, a viewer) is a listener: a function that is called with each
event as it happens. The pipeline knows none of them.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import CapacityError, DatasetError, FrameError, LostFrameError
from taichi_mrf.inference.keyframe import checked_depth
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.mapping.keyframe_selector import KeyframeSelector
from taichi_mrf.mapping.refinement import PoseChange, PoseRefiner, refiner_of
from taichi_mrf.mapping.tracking import Track, Tracker, keyframe_steps, tracker_of
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.frame import Frame


@dataclass(frozen=True)
class FrameEvent:
    """One frame has been dealt with: the ``number``-th (from 1) of ``frames``."""

    name: str
    number: int
    frames: int


@dataclass(frozen=True)
class KeyframeAdded(FrameEvent):
    """The frame is in the map as keyframe ``keyframe`` with ``rays`` measured pixels, not yet inferred."""

    keyframe: int
    rays: int


@dataclass(frozen=True)
class FramePassed(FrameEvent):
    """The frame is no keyframe, for ``reason``."""

    reason: str


@dataclass(frozen=True)
class FrameSkipped(FrameEvent):
    """The frame is broken, or tracking lost it, and it was left out; ``problem`` says what is wrong."""

    problem: str


@dataclass(frozen=True)
class KeyframeSwept:
    """The messages of one more keyframe were renewed: the ``number``-th (from 1) of ``keyframes``."""

    sweep: int
    sweeps: int
    number: int
    keyframes: int
    rays: int


@dataclass(frozen=True)
class KeyframeRefined:
    """One more keyframe was aligned with all others, or left alone: the ``number``-th (from 1) of
    ``keyframes``."""

    round: int
    rounds: int
    number: int
    keyframes: int


Event = FrameEvent | KeyframeSwept | KeyframeRefined
Listener = Callable[[Event], None]


@dataclass
class MappingResult:
    """What :func:`map_sequence` made.

    ``skipped`` tells for each broken or lost frame by name what is wrong with it, ``held_out`` the dataset
    indices of the frames that were kept out, ``seconds`` the time of each stage. ``interrupted`` is true
    if the run was told to stop before its end; the map holds everything up to there. ``poses`` are, if they
    were refined, the recorded and the refined pose of every keyframe; ``track`` says, if poses were not
    recorded but found, where each frame was taken. ``full`` names the frame that did not fit into memory,
    and says why; the map holds those before it.
    """

    map: OccupancyMap
    frames: int = 0
    held_out: list[int] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    sweeps: int = 0
    residual: float | None = None
    interrupted: bool = False
    poses: list[PoseChange] = field(default_factory=list)
    track: Track | None = None
    full: str | None = None

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time that the block takes to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


def map_sequence(
    dataset: Dataset,
    config: Config,
    listener: Listener = lambda event: None,
    *,
    every: int = 1,
    limit: int | None = None,
    skip_bad_frames: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
    resume_from: OccupancyMap | None = None,
    keep: Callable[[MappingResult], None] = lambda result: None,
) -> MappingResult:
    """Map the frames 0, ``every``, 2 ``every``, ... of a dataset, ``limit`` of them at most.

    All keyframes are added first, then the marginals are inferred. With ``config.poses.refine`` each is
    aligned with those before it as it is added, and all with each other before the marginals are inferred.
    Frames of a tracked dataset, those that are kept out included, are first aligned with the map so far.
    ``should_stop`` is asked between keyframes. A run that it ends makes one sweep over the keyframes there
    are if it has not yet, so that the map is usable. ``resume_from`` is the map of such a run, of this
    dataset: its keyframes are kept and the frames after the last of them are added, which ends in the map
    of an undisturbed run. ``keep`` is called after each keyframe, and may save what there is for such a run.
    A frame for which there is no memory ends the adding: the map of those before it is inferred.

    Raises FrameError for a broken frame unless ``skip_bad_frames``, DatasetError if no frame became a
    keyframe or the map to resume is of another recording, ConfigError if poses are to be refined
    or tracked in a map that cannot, and what the map raises.
    """
    indices = range(0, len(dataset), every)[:limit]
    result = MappingResult(create_map(config, dataset.camera) if resume_from is None else resume_from)
    if resume_from is not None:
        check_same_frames(resume_from, dataset, indices)
        if config.poses.refine:
            result.map = create_map(config, dataset.camera)
    refiner = refiner_of(result.map, config.poses)
    if refiner is not None and resume_from is not None:
        refiner.repeat(resume_from.keyframes.values())
    tracker = tracker_of(result.map, config.poses) if dataset.tracked else None
    parts = (config, listener, skip_bad_frames, should_stop, refiner, tracker, keep)
    _add_keyframes(result, dataset, indices, *parts)
    if not result.map.keyframes:
        raise DatasetError(_why_empty(dataset, result))
    if refiner is not None:
        _refine(result, refiner, config.poses.rounds, listener, should_stop)
    _infer(result, listener, should_stop)
    return result


def _add_keyframes(
    result: MappingResult,
    dataset: Dataset,
    indices: range,
    config: Config,
    listener: Listener,
    skip_bad_frames: bool,
    should_stop: Callable[[], bool],
    refiner: PoseRefiner | None,
    tracker: Tracker | None,
    keep: Callable[[MappingResult], None],
) -> None:
    """Allocate every selected frame, without inference but for what ``refiner`` needs."""
    names = dataset.frame_names
    mapped = {keyframe.name: (id, keyframe) for id, keyframe in result.map.keyframes.items()}
    selector = KeyframeSelector(config.keyframes if tracker is None else keyframe_steps(config.keyframes))
    # A camera's images cannot be read again, and its poses are not known before they are tracked.
    hold_out = 0 if tracker is not None and dataset.endless else config.evaluation.hold_out
    result.track = None if tracker is None else Track()
    last_mapped = -1
    for index in indices:
        if names[index] in mapped:
            id, keyframe = mapped[names[index]]
            T_world_camera = keyframe.T_world_camera
            if tracker is not None:
                tracker.resume(id)
            if refiner is not None:
                if tracker is None:
                    T_world_camera = dataset.read(index).T_world_camera
                refiner.know(id, T_world_camera)
            selector.accept(T_world_camera)
            last_mapped = index

    for number, index in enumerate(indices, start=1):
        if should_stop():
            result.interrupted = True
            return
        result.frames = number
        place = (names[index], number, len(indices))
        if names[index] in mapped:
            listener(FramePassed(*place, reason="in the map already"))
            continue
        held_out = is_held_out(number, hold_out)
        if held_out and tracker is None:
            result.held_out.append(index)
            listener(FramePassed(*place, reason="kept out to check the map"))
            continue
        if index < last_mapped:
            listener(FramePassed(*place, reason="looked at before"))
            continue
        frame = _read(result, dataset, index, skip_bad_frames)
        if frame is not None and tracker is not None:
            frame = _tracked(result, tracker, index, frame)
        if frame is None:
            listener(FrameSkipped(*place, problem=result.skipped[names[index]]))
        elif held_out:
            result.held_out.append(index)
            listener(FramePassed(*place, reason="kept out to check the map"))
        elif not selector.wants(frame.T_world_camera):
            listener(FramePassed(*place, reason="too near to a keyframe"))
        elif not (frame.depth_m > 0).any():
            listener(FramePassed(*place, reason="holds no measurement"))
        else:
            try:
                added = _add(result, frame, refiner)
            except CapacityError as error:
                if not result.map.keyframes:
                    raise
                result.full = f"frame {frame.name} does not fit: {error}"
                return
            if tracker is not None and result.track is not None:
                result.track.frames[index] = tracker.took(added)
            selector.accept(frame.T_world_camera)
            listener(KeyframeAdded(*place, added, result.map.keyframes[added].rays))
            keep(result)


def _add(result: MappingResult, frame: Frame, refiner: PoseRefiner | None) -> int:
    """Add a frame as a keyframe; returns its number. What is raised leaves the map without it."""
    with result.timed("adding"):
        keyframe = result.map.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, name=frame.name)
    if refiner is not None:
        with result.timed("refining"):
            try:
                refiner.place(keyframe)
            except CapacityError:
                refiner.forget(keyframe)
                raise
    return keyframe


def check_same_frames(m: OccupancyMap, dataset: Dataset, indices: range) -> None:
    """Refuse to go on with a map of another recording: each of its keyframes must be a frame of this one, and
    the last of them must hold the same depth. Raises DatasetError."""
    names = dataset.frame_names
    mapped = {keyframe.name: keyframe for keyframe in m.keyframes.values()}
    foreign = mapped.keys() - set(names)
    if foreign:
        raise DatasetError(f"the map to resume has a keyframe '{min(foreign)}', which {dataset.name} has not")
    last = next((index for index in reversed(indices) if names[index] in mapped), None)
    if last is not None and not dataset.endless:  # a camera's images cannot be read again
        recorded, known = dataset.read(last), mapped[names[last]]
        depth_m = checked_depth(recorded.depth_m, recorded.camera, m.config.sensor.min_depth)
        if known.camera != recorded.camera or not np.array_equal(depth_m, known.depth_m):
            raise DatasetError(
                f"the map to resume is of another recording than {dataset.name}: frame {names[last]} differs"
            )


def _refine(
    result: MappingResult,
    refiner: PoseRefiner,
    rounds: int,
    listener: Listener,
    should_stop: Callable[[], bool],
) -> None:
    """Align all keyframes with each other."""

    def progress(round: int, number: int, keyframes: int) -> bool:
        listener(KeyframeRefined(round, rounds, number, keyframes))
        result.interrupted = result.interrupted or should_stop()
        return not result.interrupted

    with result.timed("refining"):
        if not result.interrupted:
            try:
                refiner.rounds(progress)
            except CapacityError as error:
                result.full = result.full or f"aligning the keyframes does not fit: {error}"
    result.poses = refiner.changes()


def _infer(result: MappingResult, listener: Listener, should_stop: Callable[[], bool]) -> None:
    """Run the sweeps. The first always runs to its end, so that no keyframe is without a say; a run that
    was told to stop makes no other."""

    def progress(step: InferProgress) -> bool:
        listener(KeyframeSwept(step.sweep, step.sweeps, step.keyframe, step.keyframes, step.rays))
        result.interrupted = result.interrupted or should_stop()
        first_is_done = step.sweep > 1 or step.keyframe == step.keyframes
        return not (result.interrupted and first_is_done)

    try:
        with result.timed("inferring"):
            report = result.map.infer(sweeps=1 if result.interrupted else None, progress=progress)
    except CapacityError as error:
        result.full = f"inference does not fit: {error}"
        return
    result.sweeps, result.residual = report.sweeps, report.residual


def is_held_out(number: int, hold_out: int) -> bool:
    """Whether the ``number``-th frame (from 1) is kept out: the middle one of each ``hold_out``."""
    return hold_out > 0 and (number - 1) % hold_out == hold_out // 2


def _read(result: MappingResult, dataset: Dataset, index: int, skip_bad_frames: bool) -> Frame | None:
    """A frame, or None if it is broken and may be skipped."""
    with result.timed("reading"):
        try:
            return dataset.read(index)
        except FrameError as error:
            if not skip_bad_frames:
                raise
            result.skipped[dataset.frame_names[index]] = str(error)
            return None


def _tracked(result: MappingResult, tracker: Tracker, index: int, frame: Frame) -> Frame | None:
    """The frame where it was taken, or None if that cannot be found out."""
    assert result.track is not None
    with result.timed("tracking"):
        try:
            found, result.track.frames[index] = tracker.follow(frame)
        except LostFrameError as error:
            result.track.lost += 1
            result.skipped[frame.name] = str(error)
            return None
        return found


def _why_empty(dataset: Dataset, result: MappingResult) -> str:
    if result.interrupted:
        return f"{dataset.name}: stopped before the first keyframe"
    if result.skipped:
        count, problem = len(result.skipped), next(iter(result.skipped.values()))
        return f"{dataset.name}: no frame could be mapped; {count} are broken, the first: {problem}"
    return f"{dataset.name}: has no frame to map"
