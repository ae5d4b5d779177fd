"""The summary of several sequences: their names, and a row for each as JSON, CSV, a table or a picture."""

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from taichi_mrf.cli.map.task import Outcome
from taichi_mrf.cli.shared.print_table import print_table
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.pictures.figures import Tile
from taichi_mrf.evaluation.tables import Table
from taichi_mrf.system.files import exists, is_folder

SUMMARY_JSON, SUMMARY_CSV, SUMMARY_PICTURE = "summary.json", "summary.csv", "summary.png"
_TOP_VIEW = "top_view.png"


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


def tiles(rows: Sequence[Row], folders: Sequence[Path]) -> list[Tile]:
    """A tile for each sequence: its map from above, or why there is none."""
    return [
        Tile(row.name, row.status, None, row.error or "")
        if row.seconds is None
        else Tile(row.name, f"{accuracy_text(row)}, {row.seconds:.1f} s", folder / _TOP_VIEW)
        for row, folder in zip(rows, folders, strict=True)
    ]


def folder_names(sources: Sequence[str]) -> list[str]:
    """A name for each source: the last part of its path, or a built-in's name; where that is not enough to
    tell them apart, more of the path or the options after the question mark; at last numbers.

    The same sources always give the same names, which differ in more than upper and lower case. Raises
    ConfigError if a source is there twice.
    """
    twice = [source for source, count in Counter(sources).items() if count > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: is named twice")
    choices = [_from_short_to_long(source) for source in sources]
    lengths = [0] * len(sources)
    while True:
        names = [choice[length] for choice, length in zip(choices, lengths, strict=True)]
        counts = Counter(name.casefold() for name in names)
        longer = [
            number
            for number, name in enumerate(names)
            if counts[name.casefold()] > 1 and lengths[number] + 1 < len(choices[number])
        ]
        if not longer:
            return _numbered(names)
        for number in longer:
            lengths[number] += 1


def _from_short_to_long(source: str) -> list[str]:
    """Possible names of the source."""
    path, mark, _ = source.partition("?")
    if exists(Path(source)):
        path, mark = source, ""
    folder = Path(path)
    if folder.name in ("", ".."):
        folder = folder.resolve()
    last = folder.name if is_folder(folder) else folder.stem
    parts = [*(part for part in folder.parent.parts if part != ".."), last]
    names = [_plain("_".join(parts[-count:])) for count in range(1, len(parts) + 1)]
    return [*names, _plain(source)] if mark else names


def _plain(text: str) -> str:
    """The text with nothing in it that a file system or a shell could mind."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("._") or "sequence"


def _numbered(names: list[str]) -> list[str]:
    """The names, with a number behind those that are taken already."""
    taken: set[str] = {name.casefold() for name in names}
    used: set[str] = set()
    unique = []
    for name in names:
        candidate, number = name, 2
        while candidate.casefold() in used or (candidate != name and candidate.casefold() in taken):
            candidate, number = f"{name}_{number}", number + 1
        used.add(candidate.casefold())
        unique.append(candidate)
    return unique
