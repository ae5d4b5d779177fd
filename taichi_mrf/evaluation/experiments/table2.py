"""In the manner of MRFMap's Table II: a furnished room, a Kinect's noise, keyframes by geometry.

Beside the accuracy, how far the probabilities can be trusted: against the occupancy that the mesh gives.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.synthetic.mesh_scene import load_mesh
from taichi_mrf.evaluation.experiments.contenders import Contender, standard_contenders
from taichi_mrf.evaluation.experiments.folds import Experiment, Scored, flatten, fold_key, require_views
from taichi_mrf.evaluation.experiments.judging import build, judge_all
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import HOUSE, NOISY, Scene, keyframes_of, living_room_scene
from taichi_mrf.evaluation.experiments.tuning import score_table, tuned_contender
from taichi_mrf.evaluation.occupancy_scores import OccupancyScores, score_occupancy
from taichi_mrf.evaluation.occupancy_truth import OccupancyTruth, occupancy_truth
from taichi_mrf.evaluation.pictures.reliability import reliability_figure, roc_figure
from taichi_mrf.evaluation.tables import Entry, Spread, Table, write_table
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.files import is_folder

THRESHOLD = 0.5
"""A view becomes a keyframe when it is turned (radians, tangent norm) or moved (metres) by more. The paper
uses 1.0 in a larger room and 0.5 in a small one; this camera turns round in a circle of 0.6 m, where 1.0
would leave 5 keyframes that do not see all of the room."""

PAPERS_THRESHOLD = 1.0
"""The threshold for a folder that the user gives, as in the paper's larger room."""

MORE_LIKELY_THAN_NOT = float(np.nextafter(np.float32(0.5), np.float32(1)))
"""Just above 0.5, the probability of unknown voxels in recursive maps."""

PAPER = {
    ("MRFMap, omega", 0.01): Spread(0.945, 0.097),
    ("MRFMap, omega", 0.02): Spread(0.939, 0.101),
    ("MRFMap, omega", 0.05): Spread(0.891, 0.114),
    ("OctoMap-style, all leaves", 0.01): Spread(0.922, 0.105),
    ("OctoMap-style, all leaves", 0.02): Spread(0.882, 0.108),
    ("OctoMap-style, all leaves", 0.05): Spread(0.723, 0.113),
}
"""Shankar & Michael 2020, Table II: another living room."""


def run_table2(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Accuracy on all views' clean depth, and in the house the probabilities against the mesh's occupancy."""
    scene = living_room_scene(experiment.data, experiment.seeds[0], experiment.limit)
    require_views(scene, 2)
    ours = is_folder(experiment.data / HOUSE)
    keyframes, threshold = keyframes_of_room(experiment, scene)
    scored: list[Scored] = []
    occupancy: list[tuple[float, str, OccupancyScores]] = []
    for voxel_size in experiment.voxel_sizes:
        results = _results(experiment, scene, keyframes, voxel_size, mesh=ours)
        for name, result in results.items():
            scored += flatten(result, name, voxel_size, experiment.seeds[0])
            if ours:
                occupancy.append((voxel_size, name, OccupancyScores.from_json(result["occupancy"])))
    given = not ours and is_folder(experiment.data / NOISY)
    with_noise = f"the measurements in {NOISY}/" if given else "simulated Kinect noise"
    room = "another room" if ours else "livingroom1 of the Augmented ICL-NUIM Dataset, all its frames"
    notes = [
        f"{scene.name} with {with_noise}, {len(keyframes)} keyframes of {len(scene.views)} views "
        f"(moved or turned by more than {threshold:g}); judged by clean depth. "
        f"The paper's figures are of {room}.",
    ]
    tables = [score_table("table2", "Table II: a living room with Kinect noise", scored, PAPER, notes)]
    mapped = {scene.views[i].name for i in keyframes}
    if len(mapped) < len(scene.views):
        of_held_out = [each for each in scored if each.view not in mapped]
        title = "Table II, only views that are no keyframes"
        tables.append(score_table("table2_held_out", title, of_held_out, {}, notes))
    if ours:
        tables.append(_occupancy_table(occupancy))
    paths = [path for table in tables for path in write_table(experiment.out, table)]
    for voxel_size in experiment.voxel_sizes if ours else ():
        of_methods = {name: scores for size, name, scores in occupancy if size == voxel_size}
        for kind, draw in (("reliability", reliability_figure), ("roc", roc_figure)):
            path = experiment.out / f"table2_{kind}_{voxel_size * 1000:g}mm.png"
            with atomic_path(path) as temporary:
                draw(of_methods).savefig(temporary, dpi=130)
            paths.append(path)
    return tables, paths


def keyframes_of_room(experiment: Experiment, scene: Scene) -> tuple[list[int], float]:
    """The views that are mapped, and the least turn and way between them."""
    threshold = THRESHOLD if is_folder(experiment.data / HOUSE) else PAPERS_THRESHOLD
    return keyframes_of(scene, threshold, threshold), threshold


def _results(
    experiment: Experiment, scene: Scene, keyframes: Sequence[int], voxel_size: float, *, mesh: bool
) -> dict[str, Result]:
    """Results of each contender's map: figures of all views, and with a mesh scores of its probabilities."""
    truths: list[OccupancyTruth] = []  # made when the first map needs it

    def compute(contender: Contender) -> Result:
        if mesh and not truths:
            truths.append(_truth(experiment, scene, keyframes, voxel_size))
        m, seconds = build(contender, scene, voxel_size, keyframes)
        result = judge_all(m, seconds, contender, scene, range(len(scene.views)))
        return result | {"occupancy": _score(m, truths[0]).to_json()} if mesh else result

    contenders = [
        *standard_contenders(),
        tuned_contender(experiment, scene, experiment.seeds[0], voxel_size, keyframes),
    ]
    results = {}
    for number, contender in enumerate(contenders):
        experiment.report(f"{contender.name}, {voxel_size * 100:g} cm", number, len(contenders))
        results[contender.name] = experiment.ledger.result(
            fold_key(
                scene, experiment.seeds[0], contender, voxel_size,
                f"{len(keyframes)} keyframes, {len(scene.views)} views",
            ),
            lambda c=contender: compute(c),  # type: ignore[misc]
        )  # fmt: skip
    return results


def _truth(
    experiment: Experiment, scene: Scene, keyframes: Sequence[int], voxel_size: float
) -> OccupancyTruth:
    """Occupied and free voxels, as far as the keyframes could see them."""
    views = [scene.views[i] for i in keyframes]
    return occupancy_truth(
        load_mesh(experiment.data / "meshes" / "house.ply"),
        [view.true_m for view in views],
        [view.T_world_camera for view in views],
        scene.pinhole,
        voxel_size,
    )


def _score(m: OccupancyMap, truth: OccupancyTruth) -> OccupancyScores:
    found = [(m.marginals.occupancy(centres), occupied) for centres, occupied in truth.blocks()]
    return score_occupancy(
        np.concatenate([p for p, _ in found]),
        np.concatenate([o for _, o in found]),
        threshold=MORE_LIKELY_THAN_NOT,
    )


def _occupancy_table(occupancy: Sequence[tuple[float, str, OccupancyScores]]) -> Table:
    rows: list[list[Entry]] = [
        [f"{size * 100:g} cm", name, s.precision, s.recall, s.roc_area, s.brier, s.calibration_error,
         s.occupied, s.count]
        for size, name, s in occupancy
    ]  # fmt: skip
    return Table(
        "table2_occupancy",
        "Probabilities against the mesh's occupancy",
        ["voxels", "map", "precision", "recall", "ROC area", "Brier score", "expected calibration error",
         "occupied", "judged voxels"],
        rows,
        [
            "Occupied voxels have a surface that some keyframe's clean ray ends at; free ones are crossed by "
            "clean rays and touched by no surface. Precision and recall are of voxels more likely occupied "
            "than not."
        ],
        digits=4,
    )  # fmt: skip
