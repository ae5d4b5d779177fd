"""One walk, tracked and mapped as ``taichi-mrf map --track-poses`` does: its errors, its time, its map."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import numpy as np

from benchmarks.lab.poses import aligned
from benchmarks.lab.trajectory.walks import HOLD_OUT, Walk
from benchmarks.lab.trajectory_error import step_errors, trajectory_error
from taichi_mrf.config.schema import Config, EvaluationConfig, PoseConfig, VolumeConfig
from taichi_mrf.evaluation.experiments.contenders import mrf
from taichi_mrf.evaluation.experiments.judging import judge_all
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.mapping.pipeline import Event, map_sequence
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.mapping.tracking import STEPS
from taichi_mrf.methods.capabilities import can_refine_poses
from taichi_mrf.methods.protocol import OccupancyMap

TRACKING, LOOPS_CLOSED = "tracking", "tracking, loops closed"

WARM_UP = 8
"""Frames that are tracked before the first walk, so that compiling kernels is not part of its time."""

MOST_VIEWS = 12
"""Held-out views that judge a map, at most."""

FIGURES = ("1.5sigma", "5cm", "log_likelihood")
"""Of the held-out views."""


def configurations(voxel_size: float) -> dict[str, Config]:
    """Of maps whose camera is tracked, without loop closure and with it, by the name of the way."""
    base = Config(voxel_size=voxel_size, keyframes=STEPS, evaluation=EvaluationConfig(hold_out=HOLD_OUT))
    switched = {TRACKING: False, LOOPS_CLOSED: True}
    return {name: replace(base, poses=PoseConfig(close_loops=on)) for name, on in switched.items()}


@dataclass(frozen=True)
class Followed:
    """The map of a walk, the pose of each tracked frame by index, the indices of those that tracking calls
    unsure, and the processor's seconds for tracking and adding keyframes."""

    result: MappingResult
    poses: dict[int, Pose]
    unsure: set[int]
    cpu_s: float


def followed(walk: Walk, config: Config, infer: bool = True) -> Followed:
    """Track and map a walk; without ``infer`` its marginals are left out."""
    start = last = time.process_time()

    def listen(event: Event) -> None:
        nonlocal last
        if not isinstance(event, InferProgress):
            last = time.process_time()

    result = map_sequence(
        replace(walk, tracked=True), config, listen, skip_bad_frames=True, out_of_time=lambda: not infer
    )
    track = result.track
    assert track is not None
    unsure = {index for index, frame in track.frames.items() if frame.directions < 6}
    return Followed(result, track.poses(result.map), unsure, last - start)


def tracked_result(walk: Walk, config: Config, judge: bool) -> Result:
    """Errors of a tracked walk, and with ``judge`` figures of its map at held-out views."""
    followed(replace(walk, frames=walk.frames[:WARM_UP]), config, infer=False)
    run = followed(walk, config, infer=judge)
    result = error_result(walk, run.poses, run.unsure, run.cpu_s)
    if judge:
        result["map"] = map_figures(run.result.map, walk, run.poses)
    return result


def error_result(walk: Walk, poses: Mapping[int, Pose], unsure: set[int] | None, cpu_s: float) -> Result:
    """Errors of a walk's poses by index, of which ``unsure`` ones are said to be so; None if nothing is said
    of that. ``cpu_s``: the processor's seconds."""
    estimated = {float(index): T for index, T in poses.items()}
    steps = step_errors(estimated, walk.true_poses)
    turns_rad, moves_m = largest_step(walk)
    doubted = unsure or set()
    return asdict(trajectory_error(estimated, walk.true_poses)) | {
        "moves_m": moves_m,
        "turns_rad": turns_rad,
        "of": len(walk.frames),
        "lost": len(walk.frames) - len(poses),
        "unsure": None if unsure is None else len(unsure),
        "unsure_step_m": _rms([error for index, error in steps.items() if index in doubted]),
        "sure_step_m": _rms([error for index, error in steps.items() if index not in doubted]),
        "cpu_s": cpu_s / len(walk.frames),
    }


def recorded_result(walk: Walk, config: Config) -> Result:
    """Figures of the map of the walk's own poses at the same held-out views."""
    result = map_sequence(walk, config)
    poses = {index: walk.frames[index].T_world_camera for index in walk.clean_m}
    return {"map": map_figures(result.map, walk, poses)}


def map_figures(m: OccupancyMap, walk: Walk, poses: Mapping[int, Pose]) -> dict[str, float]:
    """Means over held-out views that have a pose, each aligned with the map first; empty without any."""
    assert can_refine_poses(m)
    known = [i for i in walk.clean_m if i in poses]
    views = [
        SceneView(frame.name, poses[i], frame.depth_m, walk.clean_m[i], walk.clean_m[i] > 0)
        for i in known[:: -(-len(known) // MOST_VIEWS) or 1]
        for frame in (walk.frames[i],)
    ]
    if not views:
        return {}
    scene = Scene(walk.name, walk.camera, m.noise, VolumeConfig(), m.sensor.max_depth, views)
    scene = replace(scene, views=[aligned(m, scene, view) for view in views])
    judged = judge_all(m, 0.0, mrf(), scene, range(len(views)))["readings"][""].values()
    means = {name: float(np.mean([figures[name] for figures in judged])) for name in FIGURES}
    return means | {"views": len(views)}


def largest_step(walk: Walk) -> tuple[float, float]:
    """By how many radians and metres the camera moves from one frame to the next, at most."""
    poses = [frame.T_world_camera for frame in walk.frames]
    steps = np.array([tangent_norms(a, b) for a, b in pairwise(poses)])
    rotation, translation = steps.max(axis=0) if len(steps) else (0.0, 0.0)
    return float(rotation), float(translation)


def _rms(errors: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None
