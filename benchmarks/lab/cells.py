"""`python -m benchmarks.lab cells`: how far the probabilities of cells, balls and paths can be trusted.

Maps of half of the house's views and of views of the built-in room, as they stand and turned, are asked for
cells of 1, 2, 4 and 8 voxels, and for balls that stand still or move for a metre, at random places in free
space, by their marginals and calibrated. The truth is that of cell_truth.py.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.lab.cell_truth import NOT_JUDGED, OCCUPIED, SeenSpace, occupied_bricks, true_cells
from taichi_mrf import MRFMap, open_dataset
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh, load_mesh, scene_mesh
from taichi_mrf.evaluation.experiments.contenders import Contender, mrf
from taichi_mrf.evaluation.experiments.folds import Experiment, fold_key, require_views
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView, house_scene, turned
from taichi_mrf.evaluation.occupancy_scores import OccupancyScores, reliability_bins, score_occupancy
from taichi_mrf.evaluation.occupancy_truth import OccupancyTruth, occupancy_truth
from taichi_mrf.evaluation.pictures.reliability import reliability_figure
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.queries.cells import cell_probabilities
from taichi_mrf.queries.known_bricks import BrickReader, sorted_bricks
from taichi_mrf.queries.points import probability
from taichi_mrf.system.atomic import atomic_path

READINGS = ("marginal", "calibrated")
SIDES = (1, 2, 4, 8)
RADII_M = (0.1, 0.2)
PATHS, LENGTH_M = 6000, 1.0
PRECISION = 0.9
DECILES = 10
LEAST_IN_BIN = 30
"""A bin with fewer answers says nothing of a share within a few points."""

_PLACES = 41
"""Points of a path at which the truth is looked up, 2.5 cm apart."""

_ROOM = "synthetic:room?width=320&height=240"


@dataclass(frozen=True)
class _Place:
    """A scene whose surfaces are known."""

    scene: Scene
    mesh: TriangleMesh


def run_cells(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Cells, balls and paths of each scene and voxel size."""
    cells: list[list[Entry]] = []
    moves: list[list[Entry]] = []
    paths: list[Path] = []
    places = [_house(experiment), _room(experiment)]
    for place in places + [_Place(*turned(place.scene, place.mesh)) for place in places]:
        require_views(place.scene, 2)
        for size in experiment.voxel_sizes:
            found = _result(experiment, place, size)
            where = [place.scene.name, f"{size * 100:g} cm"]
            for reading, answers in found.items():
                scores = {name: OccupancyScores.from_json(each["scores"]) for name, each in answers.items()}
                for name, each in answers.items():
                    row = _row(scores[name], each)
                    (cells if each["kind"] == "cell" else moves).append([*where, reading, name, *row])
                name = place.scene.name.replace(", ", "_")
                path = experiment.out / f"cells_{name}_{size * 1000:g}mm_{reading}.png"
                with atomic_path(path) as temporary:
                    reliability_figure(scores).savefig(temporary, dpi=130)
                paths.append(path)
    columns = ["scene", "voxels", "reading", "what", "judged", "occupied", "recall at 90% precision",
               "precision", "recall", "calibration error", "largest gap of a decile",
               "error of the product"]  # fmt: skip
    notes = [
        "Precision and recall at a probability of 0.5. The largest gap is that between the mean probability "
        f"and the share that is occupied, of tenths of the scale with at least {LEAST_IN_BIN} answers; the "
        "error of the product is the calibration error of 1 - prod(1 - p) over all voxels of a cell.",
    ]
    tables = [
        Table("cells", "Cells of 1, 2, 4 and 8 voxels a side", columns, cells, notes),
        Table("cells_paths", "Balls and paths of 1 m", columns[:-1], moves, notes),
    ]
    for table in tables:
        paths += write_table(experiment.out, table)
    return tables, paths


def _house(experiment: Experiment) -> _Place:
    """Every second view of the house, with the noise of a Kinect 1."""
    scene = house_scene(experiment.data, experiment.seeds[0])
    views = scene.views[::2][: experiment.limit]
    mesh = load_mesh(experiment.data / "meshes" / "house.ply")
    return _Place(Scene(scene.name, scene.camera, scene.noise, scene.volume, scene.max_depth, views), mesh)


def _room(experiment: Experiment, frames: int = 16) -> _Place:
    """The built-in room with its own noise."""
    dataset: Any = open_dataset(f"{_ROOM}&frames={frames}&seed={experiment.seeds[0]}", color=False)
    views = []
    for index in range(len(dataset))[: experiment.limit]:
        frame, clean = dataset.read(index), dataset.clean_depth(index)
        views.append(SceneView(frame.name, frame.T_world_camera, frame.depth_m, clean, clean > 0))
    own = MRFMap()
    scene = Scene("room", dataset.camera, own.noise, own.config.volume, own.sensor.max_depth, views)
    return _Place(scene, scene_mesh(dataset.scene))


def _result(experiment: Experiment, place: _Place, voxel_size: float) -> dict[str, Any]:
    scene, contender = place.scene, mrf(ray_density=InferenceConfig.ray_density)
    experiment.report(f"{scene.name}, {voxel_size * 100:g} cm", 0, 1)
    what = f"{len(scene.views)} views, cells and {PATHS} paths, two readings"
    return experiment.ledger.result(
        fold_key(scene, experiment.seeds[0], contender, voxel_size, what),
        lambda: _judge(contender, place, voxel_size, experiment.seeds[0]),
    )


def _judge(contender: Contender, place: _Place, voxel_size: float, seed: int) -> dict[str, Any]:
    """A map's answers on cells, balls and paths, compared with the truth."""
    scene = place.scene
    m: Any = contender.make(scene, voxel_size)
    for view in scene.views:
        m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
    m.infer()
    clean = [np.where(view.true_m < scene.max_depth, view.true_m, np.float32(0)) for view in scene.views]
    poses = [view.T_world_camera for view in scene.views]
    truth = occupancy_truth(place.mesh, clean, poses, scene.pinhole, voxel_size)
    space = SeenSpace(truth, clean, poses, scene.pinhole)
    maps = zip(READINGS, (m.layer(), m.calibrated()), strict=True)
    return {reading: _answers(read, truth, space, seed) for reading, read in maps}


def _answers(m: Any, truth: OccupancyTruth, space: SeenSpace, seed: int) -> dict[str, Any]:
    found = {_cell_name(side): _judge_cells(m, truth, side) for side in SIDES}
    for radius in RADII_M:
        draw = np.random.default_rng([seed, round(1000 * radius)])
        start = space.free_points(PATHS, draw)
        way = draw.normal(size=(PATHS, 3)) * [1.0, 1.0, 0.3]
        end = start + LENGTH_M * way / np.linalg.norm(way, axis=1, keepdims=True)
        along = np.linspace(0.0, 1.0, _PLACES)[:, None]
        places = start[:, None] + along * (end - start)[:, None]
        for name, judged, likely in (
            (f"ball, {radius * 100:g} cm", places[:, :1], m.occupied_within(start, radius)),
            (f"path, {radius * 100:g} cm", places, m.path_collision(np.stack([start, end], 1), radius)),
        ):
            found[name] = {"kind": "path", **_scores(likely, space.judge_paths(judged, radius))}
    return found


def _cell_name(side: int) -> str:
    return "voxels" if side == 1 else f"cells of {side} voxels"


def _judge_cells(m: Any, truth: OccupancyTruth, side: int) -> dict[str, Any]:
    """The bricks of the map, and those that it lacks although a surface is in them."""
    reader = BrickReader(m)
    bricks = sorted_bricks(np.concatenate([reader.bricks, occupied_bricks(truth)]))
    likely, product, states = [], [], []
    for piece, log_odds, _ in reader.batches(bricks):
        likely.append(_cells_of(log_odds, reader.pool.prior_log_odds, side))
        across = 8 // side
        free = (1.0 - probability(log_odds)).reshape(-1, across, side, across, side, across, side)
        product.append(1.0 - free.prod(axis=(2, 4, 6)).reshape(len(piece), -1))
        states.append(true_cells(truth, piece, side))
    p, independent, state = (np.concatenate(parts).reshape(-1) for parts in (likely, product, states))
    judged = state != NOT_JUDGED
    alone = reliability_bins(np.clip(independent[judged], 0, 1), state[judged] == OCCUPIED)
    return {"kind": "cell", "product": alone.calibration_error, **_scores(p, state)}


def _cells_of(log_odds: NDArray[np.float32], prior: float, side: int) -> NDArray[np.float32]:
    return probability(log_odds) if side == 1 else cell_probabilities(log_odds, prior)[side]


def _scores(likely: NDArray[np.float32], state: NDArray[np.int8]) -> dict[str, Any]:
    """Scores of those answers whose truth is known."""
    judged = state != NOT_JUDGED
    p, occupied = np.clip(likely[judged], 0.0, 1.0), state[judged] == OCCUPIED
    scores = score_occupancy(p, occupied, bins=DECILES)
    return {"scores": scores.to_json(), "recall_at_precision": recall_at_precision(p, occupied, PRECISION)}


def recall_at_precision(p: NDArray[np.floating], occupied: NDArray[np.bool_], precision: float) -> float:
    """The largest share of the occupied that a threshold on probabilities (N,) finds, when at least
    ``precision`` of all that reaches it is ``occupied`` (N,); 0 if no threshold does."""
    order = np.argsort(-p, kind="stable")
    hits = np.cumsum(occupied[order])
    last = np.append(np.diff(p[order]) != 0, True)  # of those with equal probabilities
    precise = last & (hits >= precision * np.arange(1, len(p) + 1))
    return float(hits[precise].max() / hits[-1]) if precise.any() and hits[-1] else 0.0


def _row(scores: OccupancyScores, found: dict[str, Any]) -> list[Entry]:
    bins = scores.reliability
    enough = bins.count >= LEAST_IN_BIN
    gap = float(np.abs(bins.observed - bins.predicted)[enough].max()) if enough.any() else float("nan")
    row: list[Entry] = [scores.count, scores.occupied / scores.count, found["recall_at_precision"],
                        scores.precision, scores.recall, scores.calibration_error, gap]  # fmt: skip
    return [*row, found["product"]] if "product" in found else row
