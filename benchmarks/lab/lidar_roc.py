"""The area under the ROC curve on the simulated scans on which GPOctoMap and BGKOctoMap report it.

Maps of nine of the twelve scans are asked for the probability of points that the others show to be occupied
or free: the measured points, and points on the rays in front of them. Each scan is held out once. What is
learnt or tuned is on the scans that are mapped.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.lab.kernel_inference import KernelMap, KernelModel
from benchmarks.lab.lidar_rivals import TUNED, contender_of, in_words, tuned_parameters
from taichi_mrf import UNKNOWN, MRFMap, PolynomialNoise, open_dataset
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.evaluation.experiments.contenders import Contender, lidar_mrf, log_odds, row_name, wavemap
from taichi_mrf.evaluation.experiments.folds import Experiment, fold_key, require_views
from taichi_mrf.evaluation.experiments.judging import build
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.evaluation.experiments.tuning import GRID, NAME
from taichi_mrf.evaluation.occupancy_scores import score_occupancy
from taichi_mrf.evaluation.tables import Entry, Spread, Table

FOLDS = 4
"""Scan i is held out in fold i modulo this."""

SMALLEST_VOXEL_M = 0.1
"""The resolution that the papers use for this scene; 3500 rays a scan say too little of smaller voxels."""

MAX_RANGE_M = 12.0

SIGMAS_M = (0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.18)
"""The standard deviations of range that are tried."""

READINGS: dict[str, Callable[[MRFMap], Any]] = {
    "marginal": MRFMap.layer,
    "calibrated": MRFMap.calibrated,
    "surface": lambda m: m.decided,
}
"""How an MRFMap is read."""

KERNEL = "BGK-style"
"""Rows of kernel inference."""

AS_IT_IS = ""
"""A map without another reading."""

DIAGONAL = 3.0**0.5
"""Of a voxel, in voxel sizes: free points lie at least so far in front of the measured point."""


Figures = dict[str, float]


class AnsweringMap(Protocol):
    """A map, or a reading of one."""

    @property
    def voxel_size(self) -> float: ...
    @property
    def marginals(self) -> Any: ...
    def state(self, points: ArrayLike) -> NDArray[np.int8]: ...


@dataclass(frozen=True)
class RocFold:
    """Scans to be mapped and held-out ones. ``check`` is one of the mapped, which the others are tuned by."""

    mapped: Sequence[int]
    held_out: Sequence[int]

    @property
    def check(self) -> int:
        """The scan that maps of the others are tuned by."""
        return self.mapped[len(self.mapped) // 2]

    @property
    def others(self) -> list[int]:
        """The mapped scans but the one for tuning."""
        return [i for i in self.mapped if i != self.check]


def structured_scene(data: Path, limit: int | None = None) -> Scene:
    """la3dm's structured scene. Its noise is to be learnt. Raises DatasetError."""
    dataset = open_dataset(data / "la3dm_structured")
    views = []
    for index in range(len(dataset))[:limit]:
        frame = dataset.read(index)
        depth = frame.depth_m
        views.append(
            SceneView(
                frame.name, frame.T_world_camera, depth, depth, depth > 0, frame.stamp, camera=frame.camera
            )
        )
    noise = PolynomialNoise(SIGMAS_M[:1])
    return Scene("la3dm_structured", dataset.camera, noise, VolumeConfig(), MAX_RANGE_M, views)


def roc_table(experiment: Experiment) -> Table:
    """A row for each map, or reading of an MRFMap, and voxel size."""
    scene = structured_scene(experiment.data, experiment.limit)
    require_views(scene, FOLDS)
    count = len(scene.views)
    folds = [
        RocFold([i for i in range(count) if i % FOLDS != fold], range(fold, count, FOLDS))
        for fold in range(FOLDS)
    ]
    rows: list[list[Entry]] = []
    chosen: list[str] = []
    for voxel_size in (size for size in experiment.voxel_sizes if size >= SMALLEST_VOXEL_M):
        scored: dict[str, list[Figures]] = {}
        for number, fold in enumerate(folds):
            experiment.report(f"{scene.name}, {voxel_size * 100:g} cm", number, len(folds))
            found, parameters = _fold_areas(experiment, scene, voxel_size, fold)
            chosen.append(f"{voxel_size * 100:g} cm, fold {number + 1}: {parameters}")
            for row, scans in found.items():
                scored.setdefault(row, []).extend(scans)
        for row, scans in scored.items():
            figures = [
                Spread.of([scan[key] for scan in scans]) for key in ("area", "crossed", "occupied", "free")
            ]
            rows.append([f"{voxel_size * 100:g} cm", row, *figures])
    notes = [
        "Area under the ROC curve of a map's probability at points of held-out scans: the measured points "
        "(occupied), and for each one point on its ray (free), drawn evenly between the sensor and a voxel's "
        "diagonal in front of the measured point. Unknown voxels have the map's prior. Mean and spread over "
        "scans. Crossed voxels: the area for points in voxels that a ray of a mapped scan crosses or ends "
        "in, the same points for all maps.",
        f"{count} scans, in {FOLDS} folds; every scan is held out once.",
        *chosen,
    ]
    columns = ["voxels", "map", "area", "area, crossed voxels", "unknown of occupied", "unknown of free"]
    return Table("lidar_roc", "ROC area on la3dm's structured scene", columns, rows, notes)


def _fold_areas(
    experiment: Experiment, scene: Scene, voxel_size: float, fold: RocFold
) -> tuple[dict[str, list[Figures]], str]:
    """For each row the figures of each held-out scan; and what was learnt and tuned, in words."""

    def score(contender: Contender, sigma_m: float = SIGMAS_M[0]) -> float:
        assumed = replace(scene, noise=PolynomialNoise((sigma_m,)))
        found = _areas(experiment, assumed, contender, voxel_size, fold.others, [fold.check])
        return found[AS_IT_IS][0]["area"]

    def kernel_score(model: KernelModel) -> float:
        (check,) = _kernel_areas(experiment, scene, model, voxel_size, fold.others, [fold.check])
        return check["area"]

    sigma_m = max(SIGMAS_M, key=lambda sigma_m: score(lidar_mrf(f"sigma {sigma_m:g}"), sigma_m))
    weights = max(GRID, key=lambda weights: score(weights.contender()))
    beams = tuned_parameters(voxel_size, score)
    kernel = max(KernelModel().candidates(), key=kernel_score)
    contenders: list[tuple[Contender, dict[str, Callable[[MRFMap], Any]]]] = [
        (lidar_mrf(), READINGS),
        (log_odds("OctoMap-style"), {}),
        (replace(weights.contender(), name=NAME), {}),
        (wavemap(), {}),
        (contender_of(beams, TUNED), {}),
    ]
    assumed = replace(scene, noise=PolynomialNoise((sigma_m,)))
    rows: dict[str, list[Figures]] = {}
    for contender, readings in contenders:
        found = _areas(experiment, assumed, contender, voxel_size, fold.mapped, fold.held_out, readings)
        rows |= {row_name(contender.name, reading): scans for reading, scans in found.items()}
    for name, model in ((KERNEL, KernelModel()), (f"{KERNEL}, tuned", kernel)):
        rows[name] = _kernel_areas(experiment, scene, model, voxel_size, fold.mapped, fold.held_out)
    return rows, (
        f"sigma {sigma_m * 100:g} cm; log-odds {weights.name}; wavemap-style {in_words(beams)}; "
        f"{KERNEL} {kernel.in_words()}"
    )


def _kernel_areas(
    experiment: Experiment, scene: Scene, model: KernelModel, voxel_size: float,
    mapped: Sequence[int], judged: Sequence[int],
) -> list[Figures]:  # fmt: skip
    """The figures of each judged scan under kernel inference from the mapped ones."""

    def compute() -> Result:
        m = KernelMap(model, voxel_size, [scene.views[i] for i in mapped])
        rays, _ = build(log_odds(""), scene, voxel_size, mapped)
        return {AS_IT_IS: [scan_figures(m, rays, scene.views[i], seed=i) for i in judged]}

    key = f"{scene.name} | {model} | {voxel_size:g} m | ROC of {list(judged)} by {list(mapped)}"
    scans: list[Figures] = experiment.ledger.result(key, compute)[AS_IT_IS]
    return scans


def _areas(
    experiment: Experiment,
    scene: Scene,
    contender: Contender,
    voxel_size: float,
    keyframes: Sequence[int],
    judged: Sequence[int],
    readings: Mapping[str, Callable[[MRFMap], Any]] = MappingProxyType({}),
) -> dict[str, list[Figures]]:
    """The figures of each judged scan under a map of the keyframes, by reading; AS_IT_IS without."""

    def compute() -> dict[str, list[Figures]]:
        m: Any
        m, _ = build(contender, scene, voxel_size, keyframes)
        rays, _ = build(log_odds(""), scene, voxel_size, keyframes)
        read: dict[str, Any] = {name: read(m) for name, read in readings.items()} or {AS_IT_IS: m}
        return {
            name: [scan_figures(each, rays, scene.views[i], seed=i) for i in judged]
            for name, each in read.items()
        }

    what = f"ROC of {list(judged)} by {list(keyframes)}"
    return experiment.ledger.result(fold_key(scene, 0, contender, voxel_size, what), compute)


def scan_figures(m: AnsweringMap, rays: AnsweringMap, view: SceneView, seed: int) -> Figures:
    """The areas under the ROC curve for the points of one scan: of all, and of those in voxels that ``rays``
    knows. And which share of the measured points and of the free ones is unknown to ``m``."""
    occupied, free = points_of(view, DIAGONAL * m.voxel_size, seed)
    points = np.concatenate([occupied, free])
    truth = np.arange(len(points)) < len(occupied)
    p = m.marginals.occupancy(points)
    unknown, crossed = m.state(points) == UNKNOWN, rays.state(points) != UNKNOWN
    return {
        "area": score_occupancy(p, truth).roc_area,
        "crossed": score_occupancy(p[crossed], truth[crossed]).roc_area if crossed.any() else math.nan,
        "occupied": float(unknown[truth].mean()),
        "free": float(unknown[~truth].mean()),
    }


def points_of(view: SceneView, gap_m: float, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The measured points of a scan (N, 3), and one point on the ray of each (M, 3), drawn evenly between the
    sensor and ``gap_m`` in front of the measured point; metres, in the world. Shorter rays have none."""
    camera = view.camera
    assert camera is not None  # each scan has rays of its own
    seen = view.judged
    T, rays, depth = view.T_world_camera, camera.rays()[seen], view.measured_m[seen].astype(np.float64)
    range_m = depth * np.linalg.norm(rays, axis=1)
    long = range_m > gap_m
    share = np.random.default_rng(seed).uniform(size=len(depth)) * (1 - gap_m / range_m)
    occupied = rays * depth[:, None] @ T[:3, :3].T + T[:3, 3]
    free = (rays * (share * depth)[:, None])[long] @ T[:3, :3].T + T[:3, 3]
    return occupied, free
