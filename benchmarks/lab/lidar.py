"""Lidar scans of a real building: maps of four fifths of them, judged by the ranges of the others.

The noise of the lidar is learnt for each voxel size, and the rivals' parameters are tuned, on the scans that
are mapped: beams have a width and poses an error, so that ranges differ by more than the data sheet says. The
second table is lidar_roc.py's.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.lab.learnt_noise import learnt_law, with_law
from benchmarks.lab.lidar_rivals import TUNED, contender_of, in_words, tuned_parameters
from benchmarks.lab.lidar_roc import roc_table
from taichi_mrf.config.sections import WavemapConfig
from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.experiments.contenders import Contender, lidar_mrf, log_odds, mrf, wavemap
from taichi_mrf.evaluation.experiments.folds import Experiment, Scored, flatten, fold_key, require_views
from taichi_mrf.evaluation.experiments.judging import build, judge_all
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, lidar_scene
from taichi_mrf.evaluation.experiments.tuning import tuned_contender
from taichi_mrf.evaluation.tables import Entry, Spread, Table, write_table

OPAQUE = "MRFMap, no beam passes"

EVERY, FIRST = 5, 2
"""Every fifth scan is held out, from the third on."""

RUN = 15
"""Neighbouring keyframes by which wavemap's model is tuned."""

NEAR_M = 0.2
"""An answer within this of the measurement is near it, whatever the voxel size."""

COLUMNS = {
    "1.5sigma": "1.5 voxels",
    "near": "20 cm",
    "voxel": "voxel",
    "unanswered": "unanswered",
    "median_abs": "median error (m)",
    "log_likelihood": "log-likelihood",
}
"""Figure -> heading."""


def run_lidar(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """One row for each contender and voxel size; and the table of ROC areas."""
    scene = lidar_scene(experiment.data, experiment.limit)
    require_views(scene, 4)
    held_out = range(FIRST, len(scene.views), EVERY)
    keyframes = [i for i in range(len(scene.views)) if i not in held_out]
    rows: list[list[Entry]] = []
    learnt: list[str] = []
    tuned: list[str] = []
    for voxel_size in experiment.voxel_sizes:
        experiment.report(f"learning sigma, {voxel_size * 100:g} cm", 0, 1)
        law = learnt_law(experiment, lidar_mrf(), scene, voxel_size, keyframes)
        learnt.append(_law_in_words(law, voxel_size))
        judged_scene = with_law(scene, law)
        beams = _tuned_beams(experiment, judged_scene, voxel_size, keyframes)
        tuned.append(f"{voxel_size * 100:g} cm: {in_words(beams)}")
        contenders = [
            lidar_mrf(**law["prior"]),
            mrf(OPAQUE, **law["prior"]),
            log_odds("OctoMap-style"),
            tuned_contender(experiment, judged_scene, 0, voxel_size, keyframes),
            wavemap(),
            contender_of(beams, TUNED),
        ]
        for number, contender in enumerate(contenders):
            experiment.report(f"{contender.name}, {voxel_size * 100:g} cm", number, len(contenders))
            scored = _scored(experiment, judged_scene, contender, voxel_size, keyframes, held_out)
            rows += _rows(scored, voxel_size, len(keyframes))
    notes = [
        "Share of held-out rays whose likeliest surface (argmax omega) lies within 1.5 voxels or 20 cm of "
        "the measured range, or whose voxel holds it. Rays without an answer count as wrong. "
        "Log-likelihood: mean for each ray, nats, density per metre. Mean and spread over held-out scans.",
        f"{scene.name}: {len(keyframes)} scans mapped, {len(held_out)} held out. Learnt sigma: "
        f"{', '.join(learnt)}.",
        f"wavemap-style has the parameters published for an Ouster OS0. Tuned: {'; '.join(tuned)}.",
        "With each scan cut into four pinhole images and no tuning, MRFMap was right within 1.5 voxels of 20 "
        "cm for .924 of the rays.",
    ]
    table = Table(
        "lidar", "A building by lidar", ["voxels", "map", *COLUMNS.values(), "a scan (s)"], rows, notes
    )
    areas = roc_table(experiment)
    return [table, areas], write_table(experiment.out, table) + write_table(experiment.out, areas)


def _law_in_words(law: Result, voxel_size: float) -> str:
    """The learnt sigma, and what else was learnt with it."""
    sigma_m = law["scale"] * LIDAR_SIGMA_M + law["added_m"]
    others = "".join(f", {name} {value:g}" for name, value in law["prior"].items())
    return f"{sigma_m * 100:.3g} cm for voxels of {voxel_size * 100:g} cm{others}"


def _tuned_beams(
    experiment: Experiment, scene: Scene, voxel_size: float, keyframes: Sequence[int]
) -> WavemapConfig:
    """The parameters of wavemap's model under which a run of keyframes explains every fifth of it best.
    With keyframes far apart, wider beams would be chosen than suit all of them."""
    middle = len(keyframes) // 2
    run = keyframes[max(0, middle - RUN // 2) :][:RUN]
    checks = run[FIRST::EVERY]
    others = [i for i in run if i not in checks]

    def score(contender: Contender) -> float:
        experiment.report(f"tuning {contender.name}, {voxel_size * 100:g} cm", 0, 1)
        scored = _scored(experiment, scene, contender, voxel_size, others, checks)
        readings = {each.row: [e.figures["sensor"] for e in scored if e.row == each.row] for each in scored}
        return max(float(np.mean(figures)) for figures in readings.values())

    return tuned_parameters(voxel_size, score)


def _scored(
    experiment: Experiment,
    scene: Scene,
    contender: Contender,
    voxel_size: float,
    keyframes: Sequence[int],
    judged: Sequence[int],
) -> list[Scored]:
    result = experiment.ledger.result(
        fold_key(scene, 0, contender, voxel_size, f"{list(judged)} by {len(keyframes)} scans"),
        lambda: _judged(contender, scene, voxel_size, keyframes, judged),
    )
    return list(flatten(result, contender.name, voxel_size, 0))


def _judged(
    contender: Contender, scene: Scene, voxel_size: float, keyframes: Sequence[int], judged: Sequence[int]
) -> Result:
    m, seconds = build(contender, scene, voxel_size, keyframes)
    result = judge_all(m, seconds, contender, scene, judged)
    for reading, changes in contender.readings.items():
        for view in (scene.views[i] for i in judged):
            seen = judge_view(
                m, view.true_m, view.T_world_camera, view.camera or scene.camera, mask=view.judged,
                view=m.view.with_occlusion(**changes),
            )  # fmt: skip
            near = np.abs(seen.answer_m - seen.depth_m)[seen.judged] <= NEAR_M
            result["readings"][reading][view.name]["near"] = float(near.mean())
    return result


def _rows(scored: Sequence[Scored], voxel_size: float, scans: int) -> list[list[Entry]]:
    """One row for each reading of a contender's map."""
    rows: list[list[Entry]] = []
    for name in dict.fromkeys(each.row for each in scored):
        here = [each for each in scored if each.row == name]
        figures = [Spread.of([each.figures[key] for each in here]) for key in COLUMNS]
        rows.append([f"{voxel_size * 100:g} cm", name, *figures, here[0].build_seconds / scans])
    return rows
