"""MRFMap judged by what it approximates: the factor graph in which every ray keeps its own messages.

MRFMap sends a voxel one average message for each keyframe. Here the same rays of the same keyframes become
factors of their own (factor_graph/depth_graph.py), and each map is compared with the marginals that
sum-product then gives, by the energy of its labelling in that graph, and by held-out views.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import MRFMap, PolynomialNoise, open_dataset
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.datasets.synthetic.room import SyntheticRoom
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.experiments.folds import Experiment, require_views
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView, kitchen_scene
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.factor_graph.solve import Solution, energy, solve
from taichi_mrf.inference.ray_model import AS_PRINTED
from taichi_mrf.sensor.simulate import KINECT_1

VIEWS = 32
"""Of each scene; every second one is a keyframe."""


class MRFMapAsPrinted(MRFMap):
    """MRFMap without lengths and clamps; with PRINTED the average message is all that is approximated."""

    LIMITS = AS_PRINTED


PRINTED: dict[str, Any] = {"free_share": 0.0}

CERTAIN = 20.0
"""Log-odds of a label, where a method gives nothing but labels; float32 has no probability nearer to 1."""

PASSED_ON: dict[str, Any] = {"schedule": "parallel", "damping": 0.5, "tolerance": 0.01, "iterations": 100}
"""Message passing where each ray keeps its own messages."""

PER_RAY: dict[str, LaserConfig] = {
    "each ray, sum-product": LaserConfig(method="bp", polish=0, **PASSED_ON),
    "each ray, max-product": LaserConfig(method="max-product", **PASSED_ON),
    "each ray, dual decomposition": LaserConfig(method="dd", charge="mean", step=5.0, iterations=200),
    "each ray, dual, block ascent": LaserConfig(method="dd-block", iterations=100),
}
"""Rows of the graph's own methods; the first is what all are compared with."""

MAPS: dict[str, tuple[type[MRFMap], dict[str, Any]]] = {
    "MRFMap": (MRFMap, {}),
    "MRFMap, as printed": (MRFMapAsPrinted, PRINTED),
}
"""Rows of average messages: their class, and what differs from the defaults."""


def run_exact(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """The table for the built-in room and the first views of the kitchen."""
    views = min(VIEWS, experiment.limit or VIEWS)
    scenes: tuple[tuple[Callable[[], Scene], str, int], ...] = (
        (lambda: room_scene(views), "room", 2),
        (lambda: kitchen_scene(experiment.data, views), "kitchen", 4),
    )
    tables = []
    for voxel_size in experiment.voxel_sizes:
        for make, name, every in scenes:
            scene = make()
            require_views(scene, 2)
            judge = _Judge(experiment, _thinned(scene, every), scene, voxel_size)
            result = experiment.ledger.result(
                f"{scene.name} | {len(scene.views)} views | every {every} | {voxel_size:g} m", judge.all_rows
            )
            tables.append(_table(name, scene, voxel_size, every, result))
    return tables, [path for table in tables for path in write_table(experiment.out, table)]


def room_scene(views: int, options: str = "") -> Scene:
    """The built-in room as an experiment's scene; ``options`` are more of its own, such as "&seed=1"."""
    dataset = open_dataset(f"synthetic:room?frames={views}{options}", color=False)
    assert isinstance(dataset, SyntheticRoom)
    found = []
    for index in range(len(dataset)):
        frame = dataset.read(index)
        true = dataset.clean_depth(index)
        found.append(SceneView(frame.name, frame.T_world_camera, frame.depth_m, true, true > 0))
    noise = PolynomialNoise(KINECT_1.sigma, KINECT_1.bias)
    return Scene("synthetic:room", dataset.camera, noise, VolumeConfig(), 10.0, found)


def _thinned(scene: Scene, every: int) -> Scene:
    """The scene with every ``every``-th pixel's measurement, both ways: all that any map is given."""
    views = []
    for view in scene.views:
        depth_m = np.zeros_like(view.measured_m)
        depth_m[::every, ::every] = view.measured_m[::every, ::every]
        views.append(replace(view, measured_m=depth_m))
    return replace(scene, views=views)


@dataclass(frozen=True)
class _Judge:
    """Compares maps of the thinned scene, by the views of the full one that are no keyframes."""

    experiment: Experiment
    thinned: Scene
    full: Scene
    voxel_size: float

    def all_rows(self) -> Result:
        """Figures by row, and the graph's size."""
        reference_map = self._map(MRFMap)
        graph = reference_map.factor_graph()
        size_text = f"{graph.edges:,} edges, {graph.nbytes / 1e6:.0f} MB"
        crossed = graph.degrees.to_numpy() > 1  # one is the prior
        rows: dict[str, dict[str, Any]] = {}
        reference: NDArray[np.float32] | None = None
        number, total = 0, len(PER_RAY) + len(MAPS)
        for name, config in PER_RAY.items():
            self.experiment.report(f"{self.full.name}, {name} ({size_text})", number, total)
            start = time.perf_counter()
            solution = solve(graph, config)
            seconds = time.perf_counter() - start
            marginals = _marginals(solution)
            reference = marginals if reference is None else reference
            reference_map.adopt(_log_odds(marginals))
            rows[name] = _difference(graph, marginals, reference, crossed) | {
                "bound": solution.dual,
                "steps": len(solution.trace),
                "residual": solution.trace[-1].residual,
                "seconds": seconds,
                **self._scores(reference_map),
            }
            number += 1
        assert reference is not None
        for name, (made_by, parameters) in MAPS.items():
            self.experiment.report(f"{self.full.name}, {name}", number, total)
            start = time.perf_counter()
            m = self._map(made_by, **parameters)
            seconds = time.perf_counter() - start
            marginals = m.marginals.occupancy(graph.grid.centres())  # type: ignore[union-attr]
            rows[name] = _difference(graph, marginals, reference, crossed) | {
                "bound": None,
                "steps": m.config.inference.sweeps,
                "seconds": seconds,
                **self._scores(m),
            }
            number += 1
        size = {"beams": graph.beams, "edges": graph.edges, "cells": graph.grid.cells, "bytes": graph.nbytes}
        return {"rows": rows, "graph": size | {"crossed": int(crossed.sum())}}

    def _map(self, made_by: type[MRFMap], **parameters: Any) -> MRFMap:
        scene = self.thinned
        m = made_by(
            self.voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, **parameters
        )
        for view in scene.views[::2]:
            m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
        m.infer()
        return m

    def _scores(self, m: MRFMap) -> dict[str, float]:
        """Means over the views that are no keyframes."""
        found: dict[str, list[float]] = {"1.5sigma": [], "5cm": [], "log_likelihood": []}
        for view in self.full.views[1::2]:
            judged = judge_view(
                m, view.true_m, view.T_world_camera, self.full.camera,
                measured_m=view.measured_m, noise=self.full.noise, mask=view.judged,
                by="omega",
            )  # fmt: skip
            for tolerance in ("1.5sigma", "5cm"):
                found[tolerance].append(judged.accuracy(tolerance).score)
            found["log_likelihood"].append(judged.log_likelihood())
        return {name: float(np.mean(values)) for name, values in found.items()}


def _marginals(solution: Solution) -> NDArray[np.float32]:
    if solution.marginals is not None:
        return solution.marginals
    return solution.labels.astype(np.float32)


def _log_odds(marginals: NDArray[np.float32]) -> NDArray[np.float32]:
    p = marginals.astype(np.float64)
    with np.errstate(divide="ignore"):
        return np.clip(np.log(p) - np.log1p(-p), -CERTAIN, CERTAIN).astype(np.float32)


def _difference(
    graph: FactorGraph,
    marginals: NDArray[np.float32],
    reference: NDArray[np.float32],
    crossed: NDArray[np.bool_],
) -> dict[str, float]:
    """Differences of marginals and labels from the reference over the voxels that any ray crosses."""
    labels, wanted = marginals > 0.5, reference > 0.5
    apart = np.abs(marginals - reference)[crossed]
    either = (labels | wanted)[crossed].sum()
    return {
        "mean": float(apart.mean()),
        "p95": float(np.quantile(apart, 0.95)),
        "same": 100 * float((labels == wanted)[crossed].mean()),
        "iou": float((labels & wanted)[crossed].sum() / max(1, either)),
        "energy": energy(graph, LaserConfig(), labels.astype(np.uint8)),
    }


def _table(name: str, scene: Scene, voxel_size: float, every: int, result: Result) -> Table:
    size, first = result["graph"], next(iter(result["rows"].values()))
    rows: list[list[Entry]] = []
    for row, found in result["rows"].items():
        bound = None if found["bound"] is None else round(found["bound"])
        rows.append([
            row, found["mean"], found["p95"], found["same"], found["iou"], round(found["energy"]), bound,
            found["1.5sigma"], found["5cm"], found["log_likelihood"], found["steps"], found["seconds"],
        ])  # fmt: skip
    notes = [
        f"{scene.name}, {voxel_size * 100:g} cm, {len(scene.views[::2])} keyframes with every {every}-th "
        f"pixel both ways: {size['beams']:,} factors (rays, and voxels' priors), {size['edges']:,} edges, "
        f"{size['crossed']:,} voxels that rays cross, {size['bytes'] / 1e6:.0f} MB.",
        "Difference of marginals, and labels (p > 0.5), against the first row, over those voxels; labels of "
        "dual decomposition and max-product count as certain. Energy: of the labels, in the graph of all "
        "rays; bound: no labelling is lower.",
        f"The last iteration of the first row moved {100 * first['residual']:.2g}% of the voxels by more "
        f"than {PASSED_ON['tolerance']} (log-odds).",
        "1.5sigma, 5cm, log-likelihood: on the views that are no keyframes, all pixels.",
    ]
    columns = [
        "map", "mean difference", "95%", "same label %", "IoU occupied", "energy", "bound",
        "1.5sigma", "5cm", "log-likelihood", "iterations", "seconds",
    ]  # fmt: skip
    title = f"Average messages against a message for each ray: {name}, {voxel_size * 100:g} cm"
    return Table(f"exact_{name}_{voxel_size * 100:g}cm", title, columns, rows, notes)
