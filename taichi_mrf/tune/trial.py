"""One try: parameters in, a fresh map of the training frames out, and its scores on the held-out ones.

The verdict on a search has the scores of what it has found on views that were used neither for maps nor
for the search.
"""

import dataclasses
import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import Config, PoseConfig, without_window
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.evaluation.accuracy import JudgedView, judge_view
from taichi_mrf.evaluation.depth_intervals import interval_error, view_below
from taichi_mrf.evaluation.held_out import pooled_depth_error, surface_depth
from taichi_mrf.mapping.intake import Full, Intake
from taichi_mrf.mapping.settling import FullInference
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.tune.working_set import VoxelTruth, WorkingSet, thinned
from taichi_mrf.viewer.tune.messages import KINDS, Scores, Verdict

SHIPPED, STARTED, FOUND = "shipped defaults", "where the search began", "found"

GoOn = Callable[[str, float], bool]
"""Called between two keyframes with the present activity and the share that is done (0 to 1); returns
whether to go on."""


@dataclass(frozen=True)
class Trial:
    """A complete try: its map, the judged held-out views, and the warnings that the map gave about the
    parameters."""

    config: Config
    map: OccupancyMap
    views: tuple[JudgedView, ...]
    scores: Scores
    warnings: tuple[str, ...]


def run_trial(
    config: Config,
    frames: WorkingSet,
    *,
    pixel_stride: int = 1,
    judged: Sequence[Frame] | None = None,
    go_on: GoOn = lambda activity, share: True,
) -> Trial | None:
    """Map the training frames with some parameters and judge the map; None if it was abandoned.

    The training frames that pass the configuration's keyframe thresholds are mapped. With
    ``pixel_stride`` only every so many-th pixel along both sides is mapped and judged. ``judged`` are the
    frames that score, the held-out ones by default. Raises what the map raises, TaichiMRFError among it.
    """
    judged = frames.held_out if judged is None else judged
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        begin = time.perf_counter()
        m = _build(config, frames, pixel_stride, go_on)
        if m is None:
            return None
        seconds = time.perf_counter() - begin
    views: list[JudgedView] = []
    below: list[NDArray[np.float32]] = []
    for number, frame in enumerate(judged):
        if not go_on(f"judging {frame.name}", number / len(judged)):
            return None
        view = judge(m, frame, pixel_stride)
        views.append(view)
        below.append(view_below(m.view, view, frame.T_world_camera, frame.camera))
    truth = frames.truth if pixel_stride == 1 else None
    scores = _score(m, views, below, seconds, pixel_stride, truth)
    said = tuple(dict.fromkeys(str(each.message) for each in caught if each.category is UserWarning))
    return Trial(config, m, tuple(views), scores, said)


def judge(m: OccupancyMap, frame: Frame, pixel_stride: int = 1) -> JudgedView:
    """Judge the map's depth in the view of a frame by what that measured, without the bias of its own noise
    or the map's. Raises FrameError if it holds no measurement in the sensor's range."""
    few = thinned(frame, pixel_stride)
    noise = frame.own_for(m.sensor).noise_model(m.noise, few.depth_m)
    return judge_view(
        m, surface_depth(few, m.noise), frame.T_world_camera, frame.camera,
        measured_m=few.depth_m, noise=noise,
    )  # fmt: skip


def _build(config: Config, frames: WorkingSet, pixel_stride: int, go_on: GoOn) -> OccupancyMap | None:
    """The map of the training frames, None if it was abandoned. Poses stay as they were recorded, so that the
    scores of two tries compare their parameters only."""
    m = create_map(without_window(config), frames.camera)
    intake = Intake(m, dataclasses.replace(config, poses=PoseConfig()))
    for number, frame in enumerate(frames.training):
        if not go_on(f"adding {frame.name}", number / len(frames.training)):
            return None
        answer = intake.offer(thinned(frame, pixel_stride))
        if isinstance(answer, Full):
            raise answer.error
    with FullInference(m) as inference:
        for step in inference:
            done = (step.sweep - 1) * step.keyframes + step.keyframe
            if not go_on(f"sweep {step.sweep} of {step.sweeps}", done / (step.sweeps * step.keyframes)):
                inference.stop(at_once=True)
    return m if inference.outcome is not None and inference.outcome.complete else None


def _score(
    m: OccupancyMap,
    views: Sequence[JudgedView],
    below: Sequence[NDArray[np.float32]],
    seconds: float,
    pixel_stride: int,
    truth: VoxelTruth | None,
) -> Scores:
    """The scores over the pixels of all views."""
    pixels = np.array([int(view.judged.sum()) for view in views])

    def pooled(of_view: Callable[[JudgedView], float]) -> float:
        return float(np.average([of_view(view) for view in views], weights=pixels))

    error = pooled_depth_error((view.answer_m, view.depth_m) for view in views)
    statistics = m.statistics()
    return Scores(
        accuracy_voxel=pooled(lambda view: view.accuracy("voxel").score),
        accuracy_sigma=pooled(lambda view: view.accuracy("1.5sigma").score),
        accuracy_5cm=pooled(lambda view: view.accuracy("5cm").score),
        unanswered=pooled(lambda view: view.accuracy("5cm").unanswered),
        median_abs_m=error.median_abs,
        rms_m=error.rms,
        log_likelihood=pooled(JudgedView.log_likelihood),
        depth_calibration=interval_error(below),
        voxel_calibration=float("nan") if truth is None else truth.calibration_error(m),
        seconds=seconds,
        voxels=statistics.voxels,
        keyframes=statistics.keyframes,
        pixel_stride=pixel_stride,
    )


def contenders(start: Config, found: Config) -> list[tuple[str, Config]]:
    """The configurations to compare: the shipped defaults with the same voxel size, method and density of
    outliers, which is the recording's, the start of the search if it differs, and the result."""
    changed: dict[str, Any] = {
        "inference": dataclasses.replace(InferenceConfig(), outlier_floor=start.inference.outlier_floor)
    }
    shipped = dataclasses.replace(
        Config(),
        voxel_size=start.voxel_size,
        method=start.method,
        volume=start.volume,
        evaluation=start.evaluation,
        runtime=start.runtime,
        **changed,
    )
    between = [] if start == shipped else [(STARTED, start)]
    return [(SHIPPED, shipped), *between, (FOUND, found)]


def judge_unseen(frames: WorkingSet, compared: Sequence[tuple[str, Config]], go_on: GoOn) -> Verdict | None:
    """Map the training frames with each of some parameters, with all pixels, and score the maps on the
    unseen frames; None if that was abandoned. Raises what mapping raises."""
    scores = {}
    for name, config in compared:
        trial = run_trial(config, frames, judged=frames.unseen, go_on=go_on)
        if trial is None:
            return None
        scores[name] = trial.scores
    sizes = {config.voxel_size for _, config in compared}
    return Verdict(len(frames.unseen), scores, one_size=len(sizes) == 1)


def verdict_lines(verdict: Verdict) -> list[str]:
    """The verdict as text, one line for each score: all contenders, and how the last differs from the
    first."""
    width = max(len(kind.label) for kind in KINDS)
    columns = [max(len(name), 10) for name in verdict.scores]
    head = "  ".join(f"{name:>{column}}" for name, column in zip(verdict.scores, columns, strict=True))
    title = f"Scores on {verdict.views} views that were never looked at before:"
    lines = [title, f"  {'':{width}}  {head}  change"]
    for kind in KINDS:
        values = [kind.value(scores) for scores in verdict.scores.values()]
        if any(map(math.isfinite, values)):
            texts = "  ".join(f"{kind.format(v):>{c}}" for v, c in zip(values, columns, strict=True))
            alike = verdict.one_size or not kind.in_voxels
            change = kind.difference(values[-1], values[0]) if alike else "other voxels"
            lines.append(f"  {kind.label:{width}}  {texts}  {change}")
    return lines
