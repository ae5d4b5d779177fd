"""The summary of several mapped sequences: a table on the terminal, as JSON and as CSV."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from taichi_mrf.cli.map.process import Outcome
from taichi_mrf.cli.shared.print_table import print_table
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.evaluation.tables import Table


@dataclass(frozen=True)
class Row:
    """One sequence in the summary: lengths in metres, ``seconds`` those of the run that mapped it. What is
    not known is None."""

    name: str
    source: str
    status: str
    seconds: float | None = None
    frames: int | None = None
    keyframes: int | None = None
    voxel_size: float | None = None
    voxels: int | None = None
    map_memory_mb: float | None = None
    peak_memory_mb: float | None = None
    median_abs: float | None = None
    rms: float | None = None
    unanswered: float | None = None
    error: str | None = None


_FROM_REPORT = ("frames", "keyframes", "voxel_size", "voxels", "map_memory_mb", "peak_memory_mb")
_FROM_ACCURACY = ("median_abs", "rms", "unanswered")


def summary_row(name: str, source: str, outcome: Outcome) -> Row:
    """The row of one sequence."""
    report = outcome.report
    if report is None:
        return Row(name, source, outcome.status, error=outcome.error)
    accuracy = report["accuracy"] or {}
    known = {key: report[key] for key in _FROM_REPORT} | {key: accuracy.get(key) for key in _FROM_ACCURACY}
    seconds = round(sum(report["seconds"].values()), 3)
    return Row(name, source, outcome.status, seconds, error=outcome.error, **known)


def summary_json(rows: Sequence[Row], facts: dict[str, Any]) -> str:
    """The summary as JSON text: the facts of the whole run, then the sequences."""
    return json.dumps({**facts, "sequences": [asdict(row) for row in rows]}, indent=2) + "\n"


def summary_csv(rows: Sequence[Row]) -> str:
    """The summary as a table for spreadsheets; what is not known is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()


def summary_line(row: Row) -> str:
    """One sequence in one line."""
    if row.seconds is None:
        return f"{row.name}: {row.status}" + (f": {row.error}" if row.error else "")
    return (
        f"{row.name}: {row.status}, {row.keyframes} keyframes, {row.voxels:,} voxels, {accuracy_text(row)}, "
        f"{row.seconds:.1f} s" + (f": {row.error}" if row.error else "")
    )


def accuracy_text(row: Row) -> str:
    """The median error on held-out frames, if there are any."""
    return "not checked" if row.median_abs is None else f"median error {100 * row.median_abs:.2f} cm"


def print_summary(console: Terminal, rows: Sequence[Row]) -> None:
    """The rows as a table, and below it why there are sequences without a map."""
    facts = ("seconds", "keyframes", "voxels", "map MB", "median cm", "RMS cm", "no answer %")
    cells = [
        (
            row.name,
            row.status,
            _number(row.seconds, 1),
            _number(row.keyframes),
            _number(row.voxels),
            _number(row.map_memory_mb),
            _number(row.median_abs, 2, 100.0),
            _number(row.rms, 1, 100.0),
            _number(row.unanswered, 1, 100.0),
        )
        for row in rows
    ]
    errors = [f"{row.name}: {row.error}" for row in rows if row.error]
    print_table(console, Table("summary", "Maps", ("sequence", "state", *facts), cells, errors))


def _number(value: float | None, digits: int = 0, scale: float = 1.0) -> str:
    return "-" if value is None else f"{scale * value:,.{digits}f}"
