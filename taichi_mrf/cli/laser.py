"""Command ``taichi-mrf laser``: read scans, build the graph, solve it, judge, write, print."""

import csv
import dataclasses
import io
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import taichi_mrf
from taichi_mrf.cli.options.laser import Laser
from taichi_mrf.cli.shared.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.print_table import print_table
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.config.text import commented_yaml
from taichi_mrf.datasets.laser.readers import open_scans
from taichi_mrf.datasets.laser.scans import FloorPlan, LaserScans, beams_of, read_floor_plan
from taichi_mrf.errors import DatasetError
from taichi_mrf.evaluation.floor_plan import (
    CellScores,
    FloorPlanScores,
    LaserMap,
    Registration,
    floor_plan_scores,
    register,
    true_cells,
)
from taichi_mrf.evaluation.pictures.laser_pictures import (
    comparison_figure,
    energy_figure,
    map_figure,
    method_name,
)
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.export.map_server import grey_image, write_map_server
from taichi_mrf.factor_graph.beams import Grid
from taichi_mrf.factor_graph.graph import FactorGraph, build_graph
from taichi_mrf.factor_graph.solve import Solution, Step, solve
from taichi_mrf.session.report import report_json
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import atomic_path, write_npz, write_text
from taichi_mrf.system.memory import peak_memory_mb

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
    folder: Path, name: str, method: str, outcome: MethodResult, path_x_y: NDArray[np.float64]
) -> list[Path]:
    """Write the map and the energies of one method into a folder; returns the paths. Raises MapFileError."""
    laser_map = outcome.map
    image = grey_image(laser_map.occupied, laser_map.seen)
    paths = write_map_server(folder, image, laser_map.cell_size, laser_map.lower_x_y)
    paths.append(_write_marginals(folder / "marginals.npz", laser_map))
    title = f"{name}: {method_name(method)}"
    paths.append(_write_figure(folder / "map.png", map_figure(laser_map, path_x_y, title)))
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
    folder: Path, maps: Mapping[str, LaserMap], path_x_y: NDArray[np.float64], plan: FloorPlan | None
) -> list[Path]:
    """Write ``maps.png``, in which the floor plan and all maps stand side by side."""
    return [_write_figure(folder / "maps.png", comparison_figure(maps, path_x_y, plan))]


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


CONFIG_FILE, REPORT_FILE = "config.yaml", "report.json"

_NO_RETURN_IS_FREE = {"auto": None, "free": True, "ignore": False}
"""True if --no-returns takes a beam without a return as free; None leaves it to the scans' reader."""


def run_laser(options: Laser) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = open_terminal(options.printing, stderr=options.json)
    with (
        output_folder(options.out),
        stop_on_signals(lambda text: console.print_line(text, "yellow")) as request,
    ):
        seconds: dict[str, float] = {}
        with _timed(seconds, "reading"):
            read = open_scans(
                options.scans,
                skip_bad_scans=options.skip_bad_scans,
                no_return_m=options.no_return_range,
            )
            scans = _some(read, options)
            registration = _floor_plan(options, scans)
            beams = beams_of(scans, options.settings.max_range, _NO_RETURN_IS_FREE[options.no_returns])
            if len(beams) == 0:
                raise DatasetError(f"{options.scans}: no beam of the {len(scans)} scans is usable")
        with _timed(seconds, "graph"):
            runtime.init(options.runtime.arch, options.runtime.threads)
            graph = build_graph(beams, options.settings.cell_size, options.memory_limit_gb)
        with _timed(seconds, "inference"), ProgressBar(console, options.printing) as bar:
            outcomes = _solve_all(options, graph, scans, registration, bar, request)
        with _timed(seconds, "writing"):
            written = _write(options, scans, outcomes, registration)
        interrupted = request()
        report = laser_report(options.scans, scans, graph, outcomes, registration, seconds, interrupted)
        write_text(options.out / REPORT_FILE, report_json(report))
        status = request.exit_status
        if options.json:
            print(report_json(report), end="")
            return status
        print_table(console, comparison_table(scans.name, outcomes))
        console.print(
            f"{graph.beams:,} beams, {graph.edges:,} edges, {report['cells_seen']:,} cells of "
            f"{graph.grid.cell_size} m, {report['graph_memory_mb']:.0f} MB",
        )
        for note in report["notes"]:
            console.print_line(f"Note: {note}")
        if interrupted:
            console.print_line("Stopped before the end.", "yellow")
        for path in [*written, options.out / REPORT_FILE]:
            console.print_line(str(path))
    return status


def _some(scans: LaserScans, options: Laser) -> LaserScans:
    """The scans that --every and --limit select."""
    chosen = slice(None, None if options.limit is None else options.limit * options.every, options.every)
    return dataclasses.replace(
        scans,
        range_m=scans.range_m[chosen],
        pose_x_y_theta=scans.pose_x_y_theta[chosen],
        hit=scans.hit[chosen],
    )


def _floor_plan(options: Laser, scans: LaserScans) -> Registration | None:
    """The floor plan that was given, or that comes with the scans, where it fits them."""
    if options.truth is not None:
        return register(read_floor_plan(options.truth, options.truth_size_x_y()), scans)
    return None if scans.floor_plan is None else register(scans.floor_plan, scans)


def _solve_all(
    options: Laser,
    graph: FactorGraph,
    scans: LaserScans,
    registration: Registration | None,
    bar: ProgressBar,
    request: StopRequest,
) -> dict[str, MethodResult]:
    """Each run's outcome, until the run is to stop: that of the first is kept in any case."""
    outcomes: dict[str, MethodResult] = {}
    for name, settings in options.runs().items():
        if outcomes and request():
            break

        solution = solve(graph, settings, _listener(name, settings.iterations, bar, request))
        laser_map = _laser_map(graph, solution)
        scores = None
        if registration is not None:
            truth = true_cells(registration.plan, laser_map, scans.pose_x_y_theta[:, :2])
            scores = floor_plan_scores(laser_map, truth)
        outcomes[name] = MethodResult(solution, laser_map, scores)
    return outcomes


def _listener(name: str, iterations: int, bar: ProgressBar, request: StopRequest) -> Callable[[Step], bool]:
    """A listener that shows each step of a method; it returns whether to continue."""

    def listen(step: Step) -> bool:
        done = min(step.iteration + 1, iterations)  # the descent at the end is one step more
        bound = "" if step.dual is None else f", bound {step.dual:,.0f}"
        bar.advance(name, done, iterations, note=f"energy {step.energy:,.0f}{bound}")
        return not request()

    return listen


def _laser_map(graph: FactorGraph, solution: Solution) -> LaserMap:
    grid = graph.grid
    assert isinstance(grid, Grid)
    marginals = solution.marginals
    return LaserMap(
        occupied=grid.image(solution.labels) > 0,
        seen=grid.image(graph.connected),
        marginals=None if marginals is None else np.ascontiguousarray(grid.image(marginals)),
        cell_size=grid.cell_size,
        lower_cell=(grid.lower[0], grid.lower[1]),
    )


def _write(
    options: Laser, scans: LaserScans, outcomes: dict[str, MethodResult], registration: Registration | None
) -> list[Path]:
    """The maps first: they are what the time went into."""
    path_x_y = scans.pose_x_y_theta[:, :2]
    written = []
    several = len(options.runs()) > 1
    for name, outcome in outcomes.items():
        folder = options.out / name if several else options.out
        folder.mkdir(exist_ok=True)
        written += write_result(folder, scans.name, name, outcome, path_x_y)
    if several:
        written += write_energies(options.out, scans.name, outcomes)
        maps = {name: outcome.map for name, outcome in outcomes.items()}
        plan = None if registration is None else registration.plan
        written += write_comparison(options.out, maps, path_x_y, plan)
        written += write_table(options.out, comparison_table(scans.name, outcomes))
    write_text(options.out / CONFIG_FILE, commented_yaml(options.settings))
    return [*written, options.out / CONFIG_FILE]


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def laser_report(
    source: str,
    scans: LaserScans,
    graph: FactorGraph,
    outcomes: Mapping[str, MethodResult],
    registration: Registration | None,
    seconds: Mapping[str, float],
    interrupted: bool,
) -> dict[str, Any]:
    """The facts of a run as plain values; lengths in metres, ``methods`` by name in the order they ran."""
    choice = runtime.choice()
    return {
        "source": source,
        "version": taichi_mrf.__version__,
        "compiler": choice.compiler if choice else None,
        "backend": choice.name if choice else None,
        "device": choice.device if choice else None,
        "interrupted": interrupted,
        "scans": len(scans),
        "measurements": scans.range_m.size,
        "no_return_share": float((~scans.hit).mean()),
        "beams": graph.beams,
        "edges": graph.edges,
        "cells": graph.grid.cells,
        "cells_seen": int(graph.connected.sum()),
        "cell_size": graph.grid.cell_size,
        "graph_memory_mb": round(graph.nbytes / 1e6, 3),
        "peak_memory_mb": peak_memory_mb(),
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
        "methods": {method: _method_report(outcome) for method, outcome in outcomes.items()},
        "floor_plan": None if registration is None else _registration_report(registration),
        "notes": [*scans.notes, *([registration.text()] if registration else [])],
    }


def comparison_table(name: str, outcomes: Mapping[str, MethodResult]) -> Table:
    """A row for each method, in the order in which they ran."""
    judged = any(outcome.scores for outcome in outcomes.values())
    columns = ["method", "energy", "dual bound", "seconds", "explained %"]
    notes = ["explained: beams of which only the last cell is occupied, or, without a return, none"]
    if judged:
        columns += [
            f"{kind} {what}" for kind in ("occupied", "free") for what in ("precision", "recall", "IoU")
        ]
        notes.append("precision, recall, IoU: against the floor plan, within one cell, where beams went")
    rows: list[list[Entry]] = []
    for method, outcome in outcomes.items():
        solution = outcome.solution
        row: list[Entry] = [
            method,
            round(solution.energy),
            None if solution.dual is None else round(solution.dual),
            _seconds(outcome),
            100 * float(solution.explained),
        ]
        if judged and outcome.scores:
            row += [*_entries(outcome.scores.occupied), *_entries(outcome.scores.free)]
        rows.append(row)
    return Table("comparison", f"Laser maps of {name}", columns, rows, notes)


def _entries(scores: CellScores) -> list[Entry]:
    return [scores.precision, scores.recall, scores.iou]


def _seconds(outcome: MethodResult) -> float:
    trace = outcome.solution.trace
    return trace[-1].seconds if trace else 0.0


def _method_report(outcome: MethodResult) -> dict[str, Any]:
    solution = outcome.solution
    return {
        "energy": solution.energy,
        "dual": solution.dual,
        "gap": None if solution.dual is None else solution.energy - solution.dual,
        "seconds": round(_seconds(outcome), 3),
        "steps": len(solution.trace),
        "explained": float(solution.explained),
        "occupied_cells": int((outcome.map.occupied & outcome.map.seen).sum()),
        "scores": None if outcome.scores is None else dataclasses.asdict(outcome.scores),
    }


def _registration_report(registration: Registration) -> dict[str, Any]:
    return {
        "shift_x_y": list(registration.shift_x_y),
        "on_walls": registration.on_walls,
        "on_walls_unshifted": registration.on_walls_unshifted,
        "walled_edge": registration.walled_edge,
        "beyond_edge": registration.beyond_edge,
    }
