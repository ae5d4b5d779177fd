"""In the manner of MRFMap's Table III: a real recording, of which every second frame is held out."""

from pathlib import Path

import numpy as np

from taichi_mrf.evaluation.experiments.contenders import standard_contenders
from taichi_mrf.evaluation.experiments.folds import Experiment, Scored, flatten, fold_key, require_views
from taichi_mrf.evaluation.experiments.judging import build_and_judge
from taichi_mrf.evaluation.experiments.scenes import MAPPED_BY, Scene, judged_scene, kitchen_scene
from taichi_mrf.evaluation.experiments.tuning import score_table, tuned_contender
from taichi_mrf.evaluation.tables import Spread, Table, write_table

PAPER = {
    ("MRFMap, omega", 0.01): Spread(0.305, 0.185),
    ("MRFMap, omega", 0.02): Spread(0.335, 0.195),
    ("MRFMap, omega", 0.05): Spread(0.406, 0.188),
    ("OctoMap-style, all leaves", 0.01): Spread(0.309, 0.192),
    ("OctoMap-style, all leaves", 0.02): Spread(0.302, 0.191),
    ("OctoMap-style, all leaves", 0.05): Spread(0.263, 0.170),
}
"""Shankar & Michael 2020, Table III: another recording, with a second camera as the truth."""


def run_table3(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Accuracy on held-out real frames, and the depth error beside the sensor's own noise."""
    judge, seed = experiment.judge, experiment.seeds[0]
    if judge is None:
        scene, title = kitchen_scene(experiment.data, experiment.limit), "Table III: a real kitchen"
    else:
        scene = judged_scene(experiment.data, judge, seed, experiment.limit)
        title = f"Table III: mapped by {MAPPED_BY}, judged by {Path(judge).stem}"
    require_views(scene, 2)
    keyframes, judged = range(0, len(scene.views), 2), range(1, len(scene.views), 2)
    mapped = f"{len(keyframes)} keyframes" + (f" of {experiment.limit} views" if experiment.limit else "")
    scored: list[Scored] = []
    for voxel_size in experiment.voxel_sizes:
        contenders = [
            *standard_contenders(),
            tuned_contender(experiment, scene, seed, voxel_size, keyframes),
        ]
        for number, contender in enumerate(contenders):
            experiment.report(f"{contender.name}, {voxel_size * 100:g} cm", number, len(contenders))
            result = experiment.ledger.result(
                fold_key(scene, seed, contender, voxel_size, mapped),
                lambda c=contender, v=voxel_size: build_and_judge(c, scene, v, keyframes, judged),  # type: ignore[misc]
            )
            scored += flatten(result, contender.name, voxel_size, seed)
    noise = _sensor_noise(scene, judged)
    notes = [
        f"{scene.name}: {len(keyframes)} keyframes, {len(judged)} held-out frames, which are measurements "
        "themselves. The paper's figures are of another recording.",
        f"The sensor's own noise (its sigma at the held-out depths): median {noise:.4f} m.",
    ]
    tables = [score_table("table3", title, scored, PAPER, notes)]
    return tables, [path for table in tables for path in write_table(experiment.out, table)]


def _sensor_noise(scene: Scene, judged: range) -> float:
    """Median over the judged pixels of their sensor's sigma at the measured depth, metres."""
    sigmas = [
        (view.noise or scene.noise).table(scene.camera).at_pixels(view.measured_m)[0][view.judged]
        for view in (scene.views[i] for i in judged)
    ]
    return float(np.median(np.concatenate(sigmas)))
