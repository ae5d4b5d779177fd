"""The files that ``taichi-mrf laser`` leaves: maps, marginals, energies, pictures."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.plan_image import FloorPlan
from taichi_mrf.evaluation.laser.floor_plan_scores import FloorPlanScores
from taichi_mrf.evaluation.laser.laser_map import LaserMap
from taichi_mrf.evaluation.pictures.laser_pictures import (
    comparison_figure,
    energy_figure,
    map_figure,
    method_name,
)
from taichi_mrf.export.map_server import grey_image, write_map_server
from taichi_mrf.factor_graph.solve import Solution
from taichi_mrf.system.atomic import atomic_path, write_npz, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 120


@dataclass(frozen=True)
class MethodResult:
    """Result of one method."""

    solution: Solution
    map: LaserMap
    scores: FloorPlanScores | None
    """None without a floor plan."""


def write_result(
    folder: Path, name: str, method: str, outcome: MethodResult, way_x_y: NDArray[np.float64]
) -> list[Path]:
    """Write the map and the energies of one method into a folder; returns the paths. Raises MapFileError."""
    laser_map = outcome.map
    image = grey_image(laser_map.occupied, laser_map.seen)
    paths = write_map_server(folder, image, laser_map.cell_size, laser_map.lower_x_y)
    paths.append(_write_marginals(folder / "marginals.npz", laser_map))
    title = f"{name}: {method_name(method)}"
    paths.append(_write_figure(folder / "map.png", map_figure(laser_map, way_x_y, title)))
    return paths + write_energies(folder, name, {method: outcome})


def write_energies(folder: Path, name: str, outcomes: Mapping[str, MethodResult]) -> list[Path]:
    """Write ``energy.csv`` (with a column for the method, if there are several) and ``energy.png``."""
    write_text(folder / "energy.csv", energy_csv(outcomes))
    traces, duals = {}, {}
    for method, outcome in outcomes.items():
        trace = outcome.solution.trace
        traces[method] = [(step.seconds, step.energy) for step in trace]
        duals[method] = [(step.seconds, step.dual) for step in trace if step.dual is not None]
    return [
        folder / "energy.csv",
        _write_figure(folder / "energy.png", energy_figure(traces, duals, f"{name}: energy against time")),
    ]


def write_comparison(
    folder: Path, maps: Mapping[str, LaserMap], way_x_y: NDArray[np.float64], plan: FloorPlan | None
) -> list[Path]:
    """Write ``maps.png``, in which the floor plan and all maps stand side by side."""
    return [_write_figure(folder / "maps.png", comparison_figure(maps, way_x_y, plan))]


def energy_csv(outcomes: Mapping[str, MethodResult]) -> str:
    """Seconds, iteration, energy and dual of every step; a dual that a method does not have is left empty."""
    several = len(outcomes) > 1
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*(["method"] if several else []), "seconds", "iteration", "energy", "dual"])
    for method, outcome in outcomes.items():
        for step in outcome.solution.trace:
            values = [
                f"{step.seconds:.6f}",
                step.iteration,
                step.energy,
                "" if step.dual is None else step.dual,
            ]
            writer.writerow([*([method] if several else []), *values])
    return out.getvalue()


def _write_marginals(path: Path, laser_map: LaserMap) -> Path:
    arrays: dict[str, NDArray[Any]] = {
        "labels": laser_map.occupied.astype(np.uint8),
        "seen": laser_map.seen,
        "cell_size": np.array(laser_map.cell_size),
        "origin": np.array(laser_map.lower_x_y),
    }
    if laser_map.marginals is not None:
        arrays["marginals"] = laser_map.marginals
    write_npz(path, arrays)
    return path


def _write_figure(path: Path, figure: "Figure") -> Path:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)
    return path
