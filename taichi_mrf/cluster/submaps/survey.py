"""Survey for the plan: the frames that become keyframes, and the chunks that their rays cross."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.cluster.runner import TaskRunner
from taichi_mrf.cluster.submaps.partial_map import PartialMap
from taichi_mrf.cluster.submaps.plan import SeenFrame, SourceFrames
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.geometry.up import Z_UP, Up, up_of
from taichi_mrf.mapping.selection import KeyframeSelector, is_held_out
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import CHUNK

FRAMES_AT_ONCE = 128
"""Frames that one task looks at."""


@dataclass(frozen=True)
class SurveyTask:
    """Look at the frames ``indices`` of a sequence."""

    sequence: SourceFrames
    config: Config
    indices: tuple[int, ...]

    def __str__(self) -> str:
        return f"frames {self.indices[0]} to {self.indices[-1]}"


@dataclass(frozen=True)
class SurveyedFrame:
    """A frame's pose, the chunks (n, 3) that its rays cross, and whether it holds any measurement, even one
    that no ray is cast for; ``problem``: why it could not be read; ``up``: its upward axis; ``sensor``:
    Frame.sensor; ``images``: names of Frame.images."""

    index: int
    name: str
    T_world_camera: Pose | None
    chunks: NDArray[np.int32]
    measured: bool = False
    problem: str | None = None
    up: Up = Z_UP
    sensor: str = ""
    images: tuple[str, ...] = ()


def survey_frames(task: SurveyTask) -> list[SurveyedFrame]:
    """Read frames and follow their rays, one frame in memory at a time. Raises DatasetError, ConfigError."""
    config = task.config
    runtime.init(config.runtime.arch, config.runtime.threads)
    dataset = task.sequence.open()
    m = PartialMap.from_config(config, dataset.camera)
    found = []
    for index in task.indices:
        name, nowhere = dataset.frame_names[index], np.zeros((0, 3), np.int32)
        try:
            frame = dataset.read(index)
        except FrameError as error:
            found.append(SurveyedFrame(index, name, None, nowhere, problem=str(error)))
            continue
        T_world_camera, chunks = as_pose(frame.T_world_camera), nowhere
        measured = frame.tells_anything(m.sensor)
        if measured:
            id = m.add(frame)
            bricks = m.all_crossed_bricks()
            if config.keep_surface:
                bricks = np.concatenate([bricks, m.measured_bricks()])
            chunks = np.unique(bricks // CHUNK, axis=0)
            m.remove_keyframe(id)
        read = up_of(T_world_camera, frame.camera.up), frame.sensor, tuple(frame.images)
        found.append(SurveyedFrame(index, name, T_world_camera, chunks, measured, None, *read))
    return found


def find_keyframes(
    sequence: SourceFrames,
    config: Config,
    runner: TaskRunner,
    skip_bad_frames: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[list[SeenFrame], dict[str, str]]:
    """The keyframes that ``map_sequence`` would choose, with the chunks that they see, and what is wrong with
    the frames that were skipped, by name.

    Raises FrameError for a broken frame unless ``skip_bad_frames``, DatasetError if no frame is a keyframe.
    """
    dataset = sequence.open()
    if dataset.endless:
        raise DatasetError(f"{dataset.name}: never ends; submaps need a recording")
    indices = range(0, len(dataset), sequence.every)[: sequence.limit]
    mapped = [i for number, i in enumerate(indices, 1) if not is_held_out(number, config.evaluation.hold_out)]
    blocks = [tuple(mapped[k : k + FRAMES_AT_ONCE]) for k in range(0, len(mapped), FRAMES_AT_ONCE)]
    tasks = [SurveyTask(sequence, config, block) for block in blocks]
    done: list[int] = []

    def count(number: int, result: list[SurveyedFrame]) -> None:
        done.append(number)
        progress(len(done), len(tasks))

    surveyed = runner.run(survey_frames, tasks, count)
    keyframes, skipped = _chosen((frame for block in surveyed for frame in block), config, skip_bad_frames)
    if not keyframes:
        problem = f"; {len(skipped)} are broken, the first: {next(iter(skipped.values()))}" if skipped else ""
        raise DatasetError(f"{dataset.name}: no frame could be mapped{problem}")
    return keyframes, skipped


def _chosen(
    frames: Iterable[SurveyedFrame], config: Config, skip_bad_frames: bool
) -> tuple[list[SeenFrame], dict[str, str]]:
    selector = KeyframeSelector(config.keyframes)
    keyframes, skipped = [], {}
    for frame in frames:
        if frame.T_world_camera is None:
            if not skip_bad_frames:
                raise FrameError(str(frame.problem))
            skipped[frame.name] = str(frame.problem)
        elif selector.objection(frame.T_world_camera, frame.measured, frame.sensor) is None:
            selector.accept(frame.T_world_camera, frame.sensor)
            if len(frame.chunks):  # else no ray is cast for it
                T = frame.T_world_camera
                x, y, z = T[:3, 3].tolist()
                keyframes.append(SeenFrame(frame.index, (x, y, z), frame.chunks, frame.up, frame.images))
    return keyframes, skipped
