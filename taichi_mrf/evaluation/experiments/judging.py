"""From a map and the views that it has not seen to figures, the same for every contender."""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.accuracy import JudgedView, judge_view
from taichi_mrf.evaluation.experiments.contenders import Contender
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.maps.protocol import OccupancyMap
from taichi_mrf.queries.view import View

Figures = dict[str, Any]


def build(
    contender: Contender, scene: Scene, voxel_size: float, keyframes: Sequence[int]
) -> tuple[OccupancyMap, float]:
    """A map of some of a scene's views, inferred, and the seconds that took."""
    start = time.perf_counter()
    m = contender.make(scene, voxel_size)
    for index in keyframes:
        view = scene.views[index]
        m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
    m.infer()
    return m, time.perf_counter() - start


def judge_all(
    m: OccupancyMap, build_seconds: float, contender: Contender, scene: Scene, judged: Iterable[int]
) -> Result:
    """Figures of some views: ``readings`` -> reading -> view's name -> figures, and what they cost."""
    start = time.perf_counter()
    by_reading: dict[str, dict[str, Figures]] = {reading: {} for reading in contender.readings}
    views = [scene.views[i] for i in judged]
    for reading, changes in contender.readings.items():
        for view in views:
            by_reading[reading][view.name] = _figures(m, scene, view, changes)
    seconds = time.perf_counter() - start
    return {
        "readings": by_reading,
        "build_seconds": build_seconds,
        "judge_seconds": seconds / max(1, len(views) * len(contender.readings)),
        "bricks": m.statistics().bricks,
    }


def build_and_judge(
    contender: Contender, scene: Scene, voxel_size: float, keyframes: Sequence[int], judged: Iterable[int]
) -> Result:
    """One fold: a map of some views, judged on others."""
    m, seconds = build(contender, scene, voxel_size, keyframes)
    return judge_all(m, seconds, contender, scene, judged)


def _figures(m: OccupancyMap, scene: Scene, view: SceneView, changes: dict[str, float]) -> Figures:
    seen = m.view.with_occlusion(**changes) if changes else m.view
    truth = judge_view(m, view.true_m, view.T_world_camera, scene.camera, mask=view.judged, view=seen)
    scores = {name: truth.accuracy(name) for name in ("voxel", "1.5sigma", "5cm")}
    error, expected = truth.depth_error(), truth.expected_depth_error()
    figures: Figures = {name: each.score for name, each in scores.items()}
    figures |= {
        "unanswered": scores["5cm"].unanswered,
        "see_through": float(np.mean(truth.survey.visibility[truth.judged] > 0.5)),
        "median_abs": error.median_abs,
        "median": error.median,
        "rms": error.rms,
        "expected_median_abs": expected.median_abs,
        "pixels": int(truth.judged.sum()),
    }
    measured = _of_the_measurement(m, scene, view, seen)
    figures["sensor"] = None if measured is None else measured.accuracy("sensor").score
    figures["log_likelihood"] = None if measured is None else measured.log_likelihood()
    return figures


def _of_the_measurement(m: OccupancyMap, scene: Scene, view: SceneView, seen: View) -> JudgedView | None:
    """The view judged by what the sensor measured; None for one that measured nothing at all."""
    try:
        return judge_view(
            m, view.measured_m, view.T_world_camera, scene.camera,
            noise=scene.noise, mask=view.judged, view=seen,
        )  # fmt: skip
    except FrameError:
        return None
