"""The report of ``taichi-mrf laser``: the contents of ``report.json``, and a table of the methods."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import taichi_mrf
from taichi_mrf.cli.laser.files import Outcome
from taichi_mrf.datasets.laser.scans import LaserScans
from taichi_mrf.evaluation.laser.floor_plan_frame import Registration
from taichi_mrf.evaluation.laser.floor_plan_scores import CellScores
from taichi_mrf.evaluation.tables import Entry, Table
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.system import runtime
from taichi_mrf.system.memory import peak_memory_mb


def laser_report(
    source: str,
    scans: LaserScans,
    graph: FactorGraph,
    outcomes: Mapping[str, Outcome],
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


def comparison_table(name: str, outcomes: Mapping[str, Outcome]) -> Table:
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


def _seconds(outcome: Outcome) -> float:
    trace = outcome.solution.trace
    return trace[-1].seconds if trace else 0.0


def _method_report(outcome: Outcome) -> dict[str, Any]:
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
