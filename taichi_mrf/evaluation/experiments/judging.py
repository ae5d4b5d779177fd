"""From a map and the views that it has not seen to figures, the same for every contender."""

import time
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.accuracy import TOLERANCES, JudgedView, boundary_depth, judge_view
from taichi_mrf.evaluation.experiments.contenders import OMEGA, Contender
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.methods.protocol import OccupancyMap

Figures = dict[str, Any]


def build(
    contender: Contender, scene: Scene, voxel_size: float, keyframes: Sequence[int]
) -> tuple[OccupancyMap, float]:
    """A map of some of a scene's views, inferred, and the seconds that took."""
    start = time.perf_counter()
    m = contender.make(scene, voxel_size)
    for index in keyframes:
        view = scene.views[index]
        camera = view.camera or scene.camera
        m.add_keyframe(view.measured_m, view.T_world_camera, camera, view.name, view.stamp_s)
    m.infer()
    return m, time.perf_counter() - start


def judge_all(
    m: OccupancyMap, build_seconds: float, contender: Contender, scene: Scene, judged: Iterable[int]
) -> Result:
    """Figures of some views: ``readings`` -> reading -> view's name -> figures, and what they cost."""
    start = time.perf_counter()
    by_reading: dict[str, dict[str, Figures]] = {"": {}} if contender.surface else {}
    count, corners = 0, (scene.volume.lower, scene.volume.upper)
    for view in (scene.views[i] for i in judged):  # one at a time: a recording may have thousands
        count += 1
        boundary_m = boundary_depth(m, view.camera or scene.camera, view.T_world_camera, *corners)
        if contender.surface:
            judged_view = _by_surface(m, scene, view, _by_voxels(m, scene, view))
            by_reading[""][view.name] = _figures(judged_view, view, boundary_m)
        for reading, changes in contender.readings.items():
            name = OMEGA if contender.surface else reading
            judged_view = _by_voxels(m, scene, view, changes)
            by_reading.setdefault(name, {})[view.name] = _figures(judged_view, view, boundary_m)
    seconds = time.perf_counter() - start
    return {
        "readings": by_reading,
        "build_seconds": build_seconds,
        "judge_seconds": seconds / max(1, count * len(by_reading)),
        "bricks": m.statistics().bricks,
    }


def build_and_judge(
    contender: Contender, scene: Scene, voxel_size: float, keyframes: Sequence[int], judged: Iterable[int]
) -> Result:
    """One fold: a map of some views, judged on others."""
    m, seconds = build(contender, scene, voxel_size, keyframes)
    return judge_all(m, seconds, contender, scene, judged)


def judged_by_voxels(
    m: OccupancyMap, scene: Scene, view: SceneView, changes: Mapping[str, float] = MappingProxyType({})
) -> JudgedView:
    """A view judged by the likeliest voxels, with some changes of the map's Occlusion."""
    return _by_voxels(m, scene, view, changes).only(view.judged)


def judged_by_surface(m: OccupancyMap, scene: Scene, view: SceneView) -> JudgedView:
    """A view judged by the measured surface where that is near the likeliest voxels, else by these."""
    return _by_surface(m, scene, view, judged_by_voxels(m, scene, view))


def _by_voxels(
    m: OccupancyMap, scene: Scene, view: SceneView, changes: Mapping[str, float] = MappingProxyType({})
) -> JudgedView:
    """All pixels with a depth, also those that do not count."""
    return judge_view(
        m, view.true_m, view.T_world_camera, view.camera or scene.camera,
        measured_m=view.measured_m, noise=view.noise or scene.noise,
        view=m.view.with_occlusion(**changes) if changes else m.view, by="omega",
    )  # fmt: skip


def _by_surface(m: OccupancyMap, scene: Scene, view: SceneView, judged: JudgedView) -> JudgedView:
    camera = view.camera or scene.camera
    return judged.by_surface(m.measured_depth(judged.answer_m, camera, view.T_world_camera))


def _figures(every: JudgedView, view: SceneView, boundary_m: NDArray[np.float64]) -> Figures:
    """Figures of the pixels that count, and by the paper's rule for rays that leave the map of all."""
    judged = every.only(view.judged)
    scores = {name: judged.accuracy(name) for name in TOLERANCES}
    error = judged.depth_error()
    return {name: score.score for name, score in scores.items()} | {
        "leaving": every.right_or_beyond(boundary_m),
        "unanswered": scores["5cm"].unanswered,
        "see_through": float(np.mean(judged.survey.visibility[judged.judged] > 0.5)),
        "median_abs": error.median_abs,
        "median": error.median,
        "rms": error.rms,
        "expected_median_abs": judged.expected_depth_error().median_abs,
        "log_likelihood": judged.log_likelihood(),
        "pixels": int(judged.judged.sum()),
    }
