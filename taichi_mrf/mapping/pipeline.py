"""A whole sequence to a map: all frames into the intake, then alignment of all keyframes, then inference.

Whoever wants to watch (a progress bar, a log) is a listener: a function that is called with each event.
"""

import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import CapacityError, ConfigError, DatasetError, FrameError
from taichi_mrf.inference.keyframe import checked_depth
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.mapping.follow import BETWEEN_FRAMES_S, FINAL_AFTER_S, follower_of
from taichi_mrf.mapping.intake import (
    HELD_OUT,
    Added,
    Answer,
    Full,
    Intake,
    Passed,
    UnreadableFrame,
    hold_out_of,
)
from taichi_mrf.mapping.onto import place_check_of
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.mapping.rounds import AlignmentRounds, PlainMover, RoundStep
from taichi_mrf.mapping.settling import FullInference
from taichi_mrf.methods.capabilities import can_freeze, window_of
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.frame import Frame


@dataclass(frozen=True)
class FrameOffered:
    """The ``number``-th frame (from 1) of ``frames`` was offered to the map, which gave an ``answer``."""

    name: str
    number: int
    frames: int
    answer: Answer


@dataclass(frozen=True)
class WaitingForPoses:
    """All frames are in, and poses that change are waited for: they have been unchanged for ``quiet_s`` of
    ``final_s`` seconds."""

    quiet_s: float
    final_s: float


Event = FrameOffered | WaitingForPoses | RoundStep | InferProgress
"""A frame was offered, poses are waited for, one more keyframe was moved by a round of alignment, or one more
was swept."""

LOOK_AGAIN_S = 0.1
"""Time between two looks at poses that change once all frames are in."""

Listener = Callable[[Event], None]


def map_sequence(
    dataset: Dataset, config: Config, listener: Listener = lambda event: None, **options: Any
) -> MappingResult:
    """Both steps of a :class:`SequenceRun`, whose ``options`` and errors these are; returns its result."""
    run = SequenceRun(dataset, config, listener, **options)
    run.add_keyframes()
    run.settle()
    return run.result


class SequenceRun:
    """Maps the frames 0, ``every``, 2 ``every``, ... of a dataset, ``limit`` of them at most, in two steps:
    :meth:`add_keyframes`, then :meth:`settle`, which infers the marginals. ``result`` has the map.

    With ``config.poses.refine`` each keyframe is aligned with those before it as it is added, and all with
    each other before the marginals are inferred. Frames of a tracked dataset, those that are held out
    included, are first aligned with the map so far. ``should_stop`` is asked between keyframes. A run that it
    ends makes one sweep over the keyframes there are if it has not yet, so that the map is usable;
    ``out_of_time`` ends that sweep too. ``resume_from`` is the map of such a run, of this dataset: its
    keyframes are kept and the frames after the last of them are added, which ends in the map of an
    undisturbed run. ``keep`` is called after each keyframe, and may save what there is for such a run.
    ``map_path`` is where the map will be saved: what leaves its window is written beside it. ``onto`` is a
    map of earlier recordings, in whose world the dataset is (mapping/onto.py): its keyframes join that map.
    A frame for which there is not enough memory ends the adding: the map of those before it is inferred.
    If the dataset's poses change meanwhile (datasets/pose_sources), keyframes follow them between frames, and
    after the last frame until the poses are final.
    """

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        listener: Listener = lambda event: None,
        *,
        every: int = 1,
        limit: int | None = None,
        skip_bad_frames: bool = False,
        should_stop: Callable[[], bool] = lambda: False,
        out_of_time: Callable[[], bool] = lambda: False,
        resume_from: OccupancyMap | None = None,
        keep: Callable[[MappingResult], None] = lambda result: None,
        map_path: Path | None = None,
        onto: OccupancyMap | None = None,
    ) -> None:
        """Makes the map, or goes on with one. Raises DatasetError if that is of another recording,
        ConfigError if poses are to be refined or tracked in a map that cannot, or refined in one of earlier
        recordings, and what the map raises."""
        if onto is not None and config.poses.refine:
            raise ConfigError(
                "poses.refine moves the keyframes of the earlier map: track poses, or keep them"
            )
        self._dataset, self._listener, self._keep = dataset, listener, keep
        self._should_stop, self._out_of_time = should_stop, out_of_time
        self._skip_bad_frames = skip_bad_frames
        self._indices = range(0, len(dataset), every)[:limit]
        if resume_from is not None:
            check_same_frames(resume_from, dataset, self._indices, onto)
        # Refined poses depend on the map at the time: a resumed run repeats the alignment in a new map.
        goes_on = resume_from is not None and not config.poses.refine
        if resume_from is not None and goes_on:
            m = resume_from
        else:
            m = create_map(config, dataset.camera) if onto is None else onto
        if map_path is not None and (window := window_of(m)) is not None:
            window.park_beside(map_path)
        hold_out, place = hold_out_of(dataset, config), place_check_of(dataset)
        self._intake = Intake(m, config, tracked=dataset.tracked, hold_out=hold_out, place=place)
        if self._intake.refiner is not None and config.poses.refine and resume_from is not None:
            self._intake.refiner.repeat(resume_from.keyframes.values())
        self._follower = follower_of(m, dataset, config.poses)
        self.result = self._intake.result
        self.result.before = 0 if onto is None else keyframes_in(onto)
        self.result.followed = None if self._follower is None else self._follower.done

    def add_keyframes(self) -> None:
        """Offer every frame that is not in the map already. Raises FrameError for an unreadable frame unless
        ``skip_bad_frames``, DatasetError if no frame became a keyframe, and what the map raises."""
        self._offer_frames()
        if keyframes_in(self.result.map) == self.result.before:
            raise DatasetError(_why_empty(self._dataset, self.result))

    def settle(self) -> None:
        """Make of the keyframes the map that they give: poses that change are followed until they are final,
        refined ones are aligned with each other, and the marginals are inferred."""
        self._follow_until_final()
        self._align()
        self._infer()

    def _offer_frames(self) -> None:
        mapped, last_mapped = self._go_on_from_mapped()
        for number, index in enumerate(self._indices, start=1):
            if self._should_stop():
                self.result.interrupted = True
                return
            self.result.frames = number
            name = self._dataset.frame_names[index]
            answer: Answer
            if name in mapped:
                answer = Passed("in the map already")
            elif self._intake.passes_unread(number, index):
                answer = HELD_OUT
            elif index < last_mapped:
                answer = Passed("offered before the run was resumed")
            else:
                answer = self._intake.offer(self._read(index), number, index)
            if isinstance(answer, Full):
                if not self._intake.map.keyframes:
                    raise answer.error
                self.result.full = answer.problem
                return
            self._listener(FrameOffered(name, number, len(self._indices), answer))
            if isinstance(answer, Added):
                self._keep(self.result)
                self._follow(answer.frame.stamp)
                if self.result.full:
                    return

    def _follow_until_final(self) -> None:
        """Let keyframes follow poses that change until these have been unchanged for FINAL_AFTER_S,
        then put each exactly where its frame was taken."""
        follower = self._follower
        if follower is None:
            return
        self._follow(math.inf)
        while not (follower.is_final or self._is_stopped() or self.result.full):
            self._listener(WaitingForPoses(min(follower.quiet_s, FINAL_AFTER_S), FINAL_AFTER_S))
            if not follower.left:
                time.sleep(LOOK_AGAIN_S)
            self._follow(math.inf)
        with self._following():
            follower.place_exactly()
        unnamed = follower.unnamed()
        if unnamed is not None:
            warnings.warn(unnamed, stacklevel=2)

    def _follow(self, stamp_s: float) -> None:
        """Move keyframes whose poses have changed, as many as there is time for between two frames."""
        follower = self._follower
        if follower is None or self.result.full:
            return
        with self._following():
            if follower.look(stamp_s):
                follower.move(BETWEEN_FRAMES_S)
        for text in follower.news():
            warnings.warn(text, stacklevel=2)

    @contextmanager
    def _following(self) -> Iterator[None]:
        with self.result.timed("following"):
            try:
                yield
            except CapacityError as error:
                self.result.full = f"moving keyframes to their new poses does not fit: {error}"

    def _align(self) -> None:
        """Align all keyframes with each other, if poses are refined."""
        refiner = self._intake.refiner
        if refiner is None:
            return
        told = (0, 0)
        with self.result.timed("refining"):
            if not self.result.interrupted:
                try:
                    with AlignmentRounds(refiner, PlainMover(refiner.map)) as rounds:
                        for step in rounds:
                            if step.moved and (step.round, step.moved) != told:
                                told = step.round, step.moved
                                self._listener(step)
                            if self._is_stopped():
                                rounds.stop()
                except CapacityError as error:
                    self.result.full = self.result.full or f"aligning the keyframes does not fit: {error}"
        self.result.poses = refiner.changes()

    def _infer(self) -> None:
        """Run the sweeps. The first always runs to its end, so that every keyframe has sent its messages,
        unless there is no time; a run that was told to stop makes no other."""
        if self._out_of_time():
            self.result.interrupted = True
            return
        sweeps = 1 if self.result.interrupted else None
        try:
            with self.result.timed("inferring"), FullInference(self._intake.map, sweeps) as inference:
                for step in inference:
                    self._listener(step)
                    if self._is_stopped():
                        inference.stop(at_once=self._out_of_time())
        except CapacityError as error:
            self.result.full = f"inference does not fit: {error}"
            return
        report = inference.outcome
        assert report is not None, "without a copy the map does not go back"
        self.result.sweeps, self.result.residual = report.sweeps, report.residual

    def _is_stopped(self) -> bool:
        self.result.interrupted = self.result.interrupted or self._should_stop()
        return self.result.interrupted

    def _go_on_from_mapped(self) -> tuple[set[str], int]:
        """Names of the frames that a resumed map holds already, and the index of the last of them, or -1."""
        m, last_mapped = self._intake.map, -1
        id_of = {keyframe.name: id for id, keyframe in m.keyframes.items()}
        for index in self._indices:
            id = id_of.get(self._dataset.frame_names[index])
            if id is not None:
                moved = self._intake.refiner is not None and self._intake.tracker is None
                recorded = self._dataset.read(index) if moved else m.keyframes[id]
                self._intake.go_on_from(id, recorded.T_world_camera, self._dataset.sensor_of(index))
                last_mapped = index
        return set(id_of), last_mapped

    def _read(self, index: int) -> Frame | UnreadableFrame:
        with self.result.timed("reading"):
            try:
                return self._dataset.read(index)
            except FrameError as error:
                if not self._skip_bad_frames:
                    raise
                return UnreadableFrame(self._dataset.frame_names[index], str(error))


def check_same_frames(
    m: OccupancyMap, dataset: Dataset, indices: range, onto: OccupancyMap | None = None
) -> None:
    """Refuse to resume a map of another recording: each of its keyframes must be a frame of this one, or of
    the map that this one goes ``onto``, and the last must hold the same depth. Raises DatasetError."""
    names = dataset.frame_names
    mapped = {keyframe.name: keyframe for keyframe in m.keyframes.values()}
    before = set() if onto is None else {keyframe.name for keyframe in onto.keyframes.values()}
    foreign = mapped.keys() - set(names) - before
    if foreign:
        raise DatasetError(f"cannot resume: keyframe '{min(foreign)}' is not in {dataset.name}")
    last = next((index for index in reversed(indices) if names[index] in mapped), None)
    if last is not None and not dataset.endless:  # a camera's images cannot be read again
        recorded, known = dataset.read(last), mapped[names[last]]
        depth_m = checked_depth(recorded.depth_m, recorded.camera, m.config.sensor.min_depth)
        if known.camera != recorded.camera or not np.array_equal(depth_m, known.depth_m):
            raise DatasetError(
                f"cannot resume: frame {names[last]} of {dataset.name} differs from the keyframe of that name"
            )


def keyframes_in(m: OccupancyMap) -> int:
    """Number of a map's keyframes, frozen ones among them."""
    return len(m.keyframes) + (len(m.frozen) if can_freeze(m) else 0)


def _why_empty(dataset: Dataset, result: MappingResult) -> str:
    if result.interrupted:
        return f"{dataset.name}: stopped before the first keyframe"
    if result.skipped:
        count, problem = len(result.skipped), next(iter(result.skipped.values()))
        return f"{dataset.name}: no frame could be mapped; {count} could not be used, the first: {problem}"
    return f"{dataset.name}: contains no frame to map"
