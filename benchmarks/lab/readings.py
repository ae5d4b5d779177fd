"""Voxels that a map calls occupied, by its marginals, states and calibrated probabilities, beside the ends of
rays.

Every pixel of held-out views follows its ray to the first voxel that is called occupied, and is judged as the
answers by the measured surface and by omega are (evaluation/accuracy.py). Beside that, how far the
probabilities can be trusted: their reliability on the voxels that measured rays saw, without and with those
behind the surface, for calibrated probabilities and for marginals.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.lab.cell_truth import hidden_voxels
from taichi_mrf import MRFMap
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh, load_mesh, scene_mesh
from taichi_mrf.datasets.synthetic.room_furniture import room_scene as furnished_room
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.experiments.contenders import mrf
from taichi_mrf.evaluation.experiments.exact import room_scene
from taichi_mrf.evaluation.experiments.folds import Experiment, fold_key, require_views
from taichi_mrf.evaluation.experiments.judging import build
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import (
    OFF_THE_GRID_M,
    Scene,
    coffin_scene,
    house_scene,
    turned,
)
from taichi_mrf.evaluation.occupancy_scores import reliability_bins
from taichi_mrf.evaluation.occupancy_truth import OccupancyTruth, occupancy_truth
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.methods.mrf.reading import MapReading
from taichi_mrf.queries.known_bricks import BrickReader
from taichi_mrf.queries.view import View
from taichi_mrf.sensor.simulate import simulate_model
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick

VIEWS = 40
"""Of each scene, at most: every second one is a keyframe, every fourth of the others is judged."""

D435_RANGE_M = 6.0
"""Beyond this the learnt noise of the D435 means nothing."""

STEP = 4
"""Pixels between the vertices of a mesh made of clean depth."""

JUMP = 1.06
"""Neighbouring depths of one surface differ by less than this factor."""

OCCUPIED = 10.0
"""Log-odds of voxels that are called occupied, so that no ray looks through them."""

BINS, LEAST_IN_BIN = 10, 100

Judged = tuple[Scene, TriangleMesh]


def run_readings(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """One table of what is occupied and one of probabilities."""
    makers: tuple[Callable[[], Judged], ...] = (
        lambda: _house(experiment, "Kinect"),
        lambda: _house(experiment, "D435"),
        lambda: _coffin(experiment),
        lambda: _room(experiment),
        lambda: turned(*_house(experiment, "Kinect")),
        lambda: turned(*_coffin(experiment)),
        lambda: turned(*_room(experiment)),
    )
    readings: list[list[Entry]] = []
    trust: list[list[Entry]] = []
    for make in makers:
        scene, mesh = make()
        require_views(scene, 4)
        contender = mrf(ray_density=2.5)
        for number, voxel_size in enumerate(experiment.voxel_sizes):
            experiment.report(scene.name, number, len(experiment.voxel_sizes))
            figures = experiment.ledger.result(
                fold_key(scene, 0, contender, voxel_size, f"{len(scene.views)} views, by answer"),
                lambda c=contender, s=scene, t=mesh, size=voxel_size: _figures(c, s, t, size),  # type: ignore[misc]
            )
            head: list[Entry] = [f"{voxel_size * 100:g} cm", scene.name]
            readings += [[*head, *row] for row in figures["readings"]]
            trust += [[*head, *row] for row in figures["trust"]]
    tables = [
        Table(
            "readings",
            "What is called occupied, and what rays end on",
            ["voxels", "scene", "answer", "1.5sigma", "5cm", "unanswered", "precision",
             "recall"],
            readings,
            ["Precision and recall are of the voxels called occupied, as in Table II."],
        ),
        Table(
            "trust",
            "How far probabilities can be trusted",
            ["voxels", "scene", "probability", "judged", "precision", "recall",
             "log-likelihood", "largest gap", *(f"{i / BINS:g}" for i in range(BINS))],
            trust,
            ["The last columns: observed share minus mean probability in each bin of at least "
             f"{LEAST_IN_BIN} voxels that measured rays told the map of; their largest size; the mean "
             "log-likelihood of a voxel. Seen: voxels that clean rays cross or end in. All: also those that "
             "are hidden behind surfaces, which count as free."],
        ),
    ]  # fmt: skip
    return tables, [path for table in tables for path in write_table(experiment.out, table)]


def _figures(contender: Any, scene: Scene, mesh: TriangleMesh, voxel_size: float) -> Result:
    keyframes = list(range(0, len(scene.views), 2))
    judged = list(range(1, len(scene.views), 8))
    built, _ = build(contender, scene, voxel_size, keyframes)
    m = cast(MRFMap, built)  # which is what contenders.mrf builds
    truth = _truth(scene, mesh, keyframes, voxel_size)
    centres, occupied = _seen(truth, scene)
    behind = _hidden(truth, m)
    maps: dict[str, MRFMap | MapReading] = {
        "marginal": m.marginals,
        "occupied": m.decided,
        "calibrated": m.calibrated(),
    }
    readings: list[list[Entry]] = [
        ["surface", *_accuracy(m, scene, judged, None), None, None],
        ["omega", *_accuracy(m, scene, judged, m.view), None, None],
    ]
    trust: list[list[Entry]] = []
    for name, shown in maps.items():
        p = shown.occupancy(centres).astype(np.float64)
        called = p > 0.5
        found = float((called & occupied).sum())
        precision, recall = found / max(1, called.sum()), found / occupied.sum()
        readings.append([name, *_accuracy(m, scene, judged, _solid(m, shown)), precision, recall])
        if name != "occupied":
            trust.append([name, "seen", *_trust(p, occupied, m.prior)])
            p = np.concatenate([p, shown.occupancy(behind)])
            trust.append([name, "all", *_trust(p, np.append(occupied, np.zeros(len(behind), bool)), m.prior)])
    return {"readings": readings, "trust": trust}


def _trust(p: NDArray[np.float64], occupied: NDArray[np.bool_], prior: float) -> list[Entry]:
    """Precision, recall, log-likelihood, and the gaps of the bins; a voxel that no ray told anything of has
    the prior, and is in no bin."""
    called = p > 0.5
    found = float((called & occupied).sum())
    scores = [found / max(1, called.sum()), found / occupied.sum()]
    told = np.abs(p - prior) > 1e-6
    p, occupied = p[told], occupied[told]
    bins = reliability_bins(p, occupied, BINS)
    gaps = np.where(bins.count >= LEAST_IN_BIN, bins.observed - bins.predicted, np.nan)
    likelihood = np.log(np.where(occupied, p, 1 - p).clip(1e-4)).mean()
    row = [*scores, likelihood, np.nanmax(np.abs(gaps)), *gaps]
    return [None if np.isnan(x) else float(x) for x in row]


def _solid(m: MRFMap, shown: MRFMap | MapReading) -> View:
    """The map with voxels that stop every ray or none, by whether they are occupied as it is ``shown``."""
    pool = shown.view.pool
    solid = ti.ndarray(ti.f32, pool.belief.shape)
    solid.from_numpy(np.where(pool.belief.to_numpy() > 0, OCCUPIED, -OCCUPIED).astype(np.float32))
    return MapReading(m, m._parts, solid).view.with_occlusion(empty_below=0.0)


def _accuracy(m: MRFMap, scene: Scene, judged: list[int], view: View | None) -> list[float]:
    """Means over views: within 1.5 voxels, within 5 cm, unanswered; by the measured surface without a
    ``view``."""
    found = []
    for index in judged:
        each = scene.views[index]
        scored = judge_view(
            m, each.true_m, each.T_world_camera, scene.camera,
            measured_m=each.measured_m, noise=scene.noise, mask=each.judged, view=view,
        )  # fmt: skip
        near = scored.accuracy("1.5sigma")
        found.append([near.score, scored.accuracy("5cm").score, near.unanswered])
    return [float(x) for x in np.mean(found, axis=0)]


def _truth(scene: Scene, mesh: TriangleMesh, keyframes: list[int], voxel_size: float) -> OccupancyTruth:
    """Voxels that measured rays of keyframes could see."""
    views = [scene.views[i] for i in keyframes]
    return occupancy_truth(
        mesh,
        [np.where(view.measured_m > 0, view.true_m, 0) for view in views],
        [view.T_world_camera for view in views],
        scene.pinhole,
        voxel_size,
    )


def _seen(truth: OccupancyTruth, scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Centres (n, 3) of the voxels that were seen, and whether they are occupied."""
    parts = list(truth.blocks())
    centres = np.concatenate([c for c, _ in parts])
    occupied = np.concatenate([o for _, o in parts])
    lower, upper = scene.volume.lower, scene.volume.upper
    if lower is not None and upper is not None:
        inside = ((centres > lower) & (centres < upper)).all(axis=1)
        centres, occupied = centres[inside], occupied[inside]
    return centres, occupied


def _hidden(truth: OccupancyTruth, m: MRFMap) -> NDArray[np.float64]:
    """Centres (n, 3) of the voxels of the map's bricks that are hidden."""
    bricks = BrickReader(m).bricks
    row, number = np.nonzero(hidden_voxels(truth, bricks))
    return (bricks[row].astype(np.float64) * BRICK + offsets_in_brick()[number] + 0.5) * m.voxel_size


def _house(experiment: Experiment, noise: str) -> Judged:
    limit = min(VIEWS, experiment.limit or VIEWS)
    scene = house_scene(experiment.data, experiment.seeds[0], limit)
    if noise == "D435":
        model = coffin_scene(experiment.data).noise
        views = []
        for index, view in enumerate(scene.views):
            true_m = np.where(view.true_m < D435_RANGE_M, view.true_m, 0).astype(np.float32)
            measured_m = simulate_model(true_m, scene.pinhole, model, seed=500 + index)
            views.append(replace(view, measured_m=measured_m))
        scene = replace(scene, name=f"{scene.name}, D435", noise=model, views=views)
    return scene, load_mesh(experiment.data / "meshes" / "house.ply")


def _coffin(experiment: Experiment) -> Judged:
    """Table I's scene, moved off the grid's planes, with a mesh made of its clean depth."""
    scene = coffin_scene(experiment.data, experiment.seeds[0])
    views = []
    for view in scene.views[: experiment.limit]:
        T_world_camera = view.T_world_camera.copy()
        T_world_camera[:3, 3] += OFF_THE_GRID_M
        views.append(replace(view, T_world_camera=T_world_camera))
    scene = replace(scene, name=f"{scene.name}, off the grid", views=views)
    vertices, triangles, count = [], [], 0
    for view in views:
        points, corners = _depth_mesh(scene, view.true_m, view.T_world_camera)
        vertices.append(points)
        triangles.append(corners + count)
        count += len(points)
    return scene, TriangleMesh(np.concatenate(vertices), np.concatenate(triangles).astype(np.int32))


def _room(experiment: Experiment) -> Judged:
    views = min(24, experiment.limit or 24)
    return room_scene(views), scene_mesh(furnished_room())


def _depth_mesh(
    scene: Scene, depth_m: NDArray[np.float32], T_world_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Triangles between neighbouring pixels of clean depth (H, W) that lie on one surface."""
    depth = depth_m[::STEP, ::STEP].astype(np.float64)
    points = (scene.camera.rays()[::STEP, ::STEP] * depth[..., None]).reshape(-1, 3)
    i = np.arange(depth.size).reshape(depth.shape)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    corners = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    near, far = depth.ravel()[corners].min(axis=1), depth.ravel()[corners].max(axis=1)
    kept = corners[(near > 0) & (far < near * JUMP)]
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3], kept
