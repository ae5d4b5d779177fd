"""Keyframes whose poses are slightly wrong, mapped as if they were exact and with a covariance.

Every second view is mapped, the others are held out. In the built-in room the mapped poses are disturbed by
a known law. In the recording half of the held-out views are aligned with the map, and how far they move says
how far poses are off; the other half judges.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.lab.poses import DISTURBED_M, DISTURBED_RAD, aligned, disturbed, kitchen, room
from taichi_mrf.alignment.se3 import twist
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.depth_intervals import interval_error, view_below
from taichi_mrf.evaluation.experiments.contenders import mrf
from taichi_mrf.evaluation.experiments.folds import Experiment, fold_key, require_views
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.evaluation.tables import Entry, Spread, Table, write_table
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.methods.capabilities import can_refine_poses
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.pose_doubt import Covariance, DoubtfulPose, covariance_of

EXACT, DOUBTFUL = "as if exact", "with covariance"
SENSOR, AND_POSE, ALIGNED = (
    "sensor's noise",
    "with covariance as well",
    "sensor's noise, aligned with the map",
)

COLUMNS = {
    "1.5sigma": "1.5sigma",
    "5cm": "5cm",
    "median_abs": "median error (m)",
    "log_likelihood": "log-likelihood",
    "calibration": "calibration error",
}
"""Figure of a map -> heading."""

NOTES = (
    "Off: standard deviation along and about each axis of the camera, which the covariance states.",
    "Views: how a held-out view's measurements are predicted: with the sensor's noise alone, with the "
    "covariance of the view's own pose as well, or from where the view fits the map.",
    "Calibration error: mean difference between the probability of central intervals of depth and the "
    "share of measurements in them.",
    "Room: held-out views at their true poses. Recording: at recorded poses, by views that the covariance "
    "was not found with.",
)


def run_doubt(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Held-out accuracy, likelihood and calibration of maps with and without the covariance of poses."""
    rows: list[list[Entry]] = []
    for voxel_size in experiment.voxel_sizes:
        for make, judge, seeds in (
            (room, disturbed_room, experiment.seeds),
            (kitchen, recording, experiment.seeds[:1]),
        ):
            scene = make(experiment)
            require_views(scene, 8)
            results = []
            for number, seed in enumerate(seeds):
                experiment.report(f"{scene.name}, {voxel_size * 100:g} cm, {seed}", number, len(seeds))
                key = fold_key(scene, seed, mrf(), voxel_size, f"{len(scene.views)} views, {judge.__name__}")
                results.append(experiment.ledger.result(key, partial(judge, scene, voxel_size, seed)))
            rows += _rows(scene.name, voxel_size, results)
    columns = ["scene", "voxels", "off (cm, degrees)", "keyframes", "views", *COLUMNS.values(), "maps"]
    table = Table("doubt", "Keyframes whose poses are uncertain", columns, rows, NOTES)
    return [table], write_table(experiment.out, table)


def disturbed_room(scene: Scene, voxel_size: float, seed: int) -> Result:
    """Maps of disturbed poses, the first of which is exact, judged at true poses."""
    mapped, held_out = range(0, len(scene.views), 2), range(1, len(scene.views), 2)
    poses = disturbed([scene.views[i].T_world_camera for i in mapped], seed)
    covariance = covariance_of(DISTURBED_M, DISTURBED_RAD)
    result: Result = {"off": [DISTURBED_M, DISTURBED_RAD]}
    for name, covariances in ((EXACT, {}), (DOUBTFUL, dict.fromkeys(mapped[1:], covariance))):
        m = _built(scene, voxel_size, dict(zip(mapped, poses, strict=True)), covariances)
        result[f"{name}, {SENSOR}"] = figures(m, scene, held_out)
    return result


def recording(scene: Scene, voxel_size: float, seed: int) -> Result:
    """Maps of recorded poses, judged at recorded poses."""
    mapped, asked, judged = (range(first, len(scene.views), step) for first, step in ((0, 2), (1, 4), (3, 4)))
    poses = {i: scene.views[i].T_world_camera for i in mapped}
    exact = _built(scene, voxel_size, poses, {})
    off = how_far_off(exact, scene, asked)
    covariance = covariance_of(*off)
    doubtful = _built(scene, voxel_size, poses, dict.fromkeys(mapped, covariance))
    result: Result = {"off": list(off)}
    for name, m in ((EXACT, exact), (DOUBTFUL, doubtful)):
        result[f"{name}, {SENSOR}"] = figures(m, scene, judged)
        result[f"{name}, {AND_POSE}"] = figures(m, scene, judged, covariance)
        there = replace(scene, views=[aligned(m, scene, scene.views[i]) for i in judged])
        result[f"{name}, {ALIGNED}"] = figures(m, there, range(len(there.views)))
    return result


def how_far_off(m: MRFMap, scene: Scene, asked: Iterable[int]) -> tuple[float, float]:
    """How far views that are not in the map move when they are aligned with it: RMS along each axis in
    metres, and about each axis in radians."""
    views = [scene.views[i] for i in asked]
    steps = [inverse(view.T_world_camera) @ aligned(m, scene, view).T_world_camera for view in views]
    squares = np.square([twist(step) for step in steps]).reshape(-1, 2, 3)
    translation, rotation = np.sqrt(squares.mean(axis=(0, 2)))
    return float(translation), float(rotation)


def figures(
    m: MRFMap, scene: Scene, judged: Iterable[int], covariance: Covariance | None = None
) -> dict[str, float]:
    """Means over views, and the calibration over all their measurements. ``covariance`` (6, 6) is that of the
    views' poses, None for exact ones."""
    each, below = [], []
    for view in (scene.views[i] for i in judged):
        noise = scene.noise
        if covariance is not None:
            noise = DoubtfulPose(noise, covariance, view.measured_m)
        seen = judge_view(
            m, view.true_m, view.T_world_camera, scene.camera, measured_m=view.measured_m, noise=noise,
            mask=view.judged, by="omega",
        )  # fmt: skip
        below.append(view_below(m.view, seen, view.T_world_camera, scene.camera))
        each.append(
            {
                "1.5sigma": seen.accuracy("1.5sigma").score,
                "5cm": seen.accuracy("5cm").score,
                "median_abs": seen.depth_error().median_abs,
                "log_likelihood": seen.log_likelihood(),
            }
        )
    return {key: Spread.of([view[key] for view in each]).mean for key in each[0]} | {
        "calibration": interval_error(below)
    }


def _built(
    scene: Scene, voxel_size: float, poses: Mapping[int, Pose], covariances: Mapping[int, Covariance]
) -> MRFMap:
    m = mrf().make(scene, voxel_size)
    assert can_refine_poses(m)
    for i, T_world_camera in poses.items():
        view = scene.views[i]
        parts = (view.measured_m, T_world_camera, scene.camera, view.name)
        m.add_keyframe(*parts, pose_covariance=covariances.get(i))
    m.infer()
    return m


def _rows(scene: str, voxel_size: float, results: Sequence[Result]) -> list[list[Entry]]:
    """One row for each map and way to judge it, means over seeds."""
    translation, rotation = results[0]["off"]
    off = f"{100 * translation:.2f}, {np.degrees(rotation):.2f}"
    rows: list[list[Entry]] = []
    for name in results[0]:
        if name != "off":
            means = (Spread(Spread.of([result[name][key] for result in results]).mean) for key in COLUMNS)
            keyframes, views = name.split(", ", 1)
            rows.append([scene, f"{voxel_size * 100:g} cm", off, keyframes, views, *means, len(results)])
    return rows
