"""A table of results as CSV, LaTeX, and a picture."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.system.atomic import atomic_path, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Spread:
    """A mean and, if there were several values, their standard deviation."""

    mean: float
    deviation: float | None = None

    @staticmethod
    def of(values: Sequence[float | None]) -> "Spread":
        """Of the values that exist; NaN if none does."""
        known = [v for v in values if v is not None and math.isfinite(v)]
        if not known:
            return Spread(math.nan)
        mean = sum(known) / len(known)
        if len(known) == 1:
            return Spread(mean)
        return Spread(mean, math.sqrt(sum((v - mean) ** 2 for v in known) / (len(known) - 1)))


Entry = Spread | float | int | str | None

_LATEX = str.maketrans(
    {mark: rf"\{mark}" for mark in "&%_#${}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
)
"""Replacements of the characters that mean something to LaTeX."""


@dataclass(frozen=True)
class Table:
    """Rows under named columns; a row's first entry is its name. ``notes`` explain how to read it."""

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Entry]]
    notes: Sequence[str] = field(default_factory=list)
    digits: int = 3


def entry_text(entry: Entry, digits: int, plus_minus: str = "±") -> str:
    """Printed form of an entry; a dash for a missing one."""
    if entry is None:
        return "-"
    if isinstance(entry, Spread):
        if not math.isfinite(entry.mean):
            return "-"
        text = f"{entry.mean:.{digits}f}"
        return text if entry.deviation is None else f"{text} {plus_minus} {entry.deviation:.{digits}f}"
    if isinstance(entry, float):
        return f"{entry:.{digits}f}" if math.isfinite(entry) else "-"
    return str(entry)


def as_csv(table: Table) -> str:
    """Comma-separated values with full digits; a spread takes two columns."""
    spread = [any(_has_deviation(row[i]) for row in table.rows) for i in range(len(table.columns))]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        [
            text
            for name, wide in zip(table.columns, spread, strict=True)
            for text in ([name, f"{name} (std)"] if wide else [name])
        ]
    )
    for row in table.rows:
        values: list[str | float | int | None] = []
        for entry, wide in zip(row, spread, strict=True):
            mean, deviation = (entry.mean, entry.deviation) if isinstance(entry, Spread) else (entry, None)
            values += [mean, deviation] if wide else [mean]
        writer.writerow(["" if v is None else v for v in values])
    return out.getvalue()


def as_latex(table: Table) -> str:
    """A tabular with booktabs' rules."""

    def cell(entry: Entry) -> str:
        return _escaped(entry) if isinstance(entry, str) else entry_text(entry, table.digits, r"$\pm$")

    lines = [rf"\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}", r"\toprule"]
    lines += [" & ".join(map(_escaped, table.columns)) + r" \\", r"\midrule"]
    for row in table.rows:
        lines.append(" & ".join(map(cell, row)) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}", *(f"% {note}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def as_figure(table: Table) -> "Figure":
    """The table as a picture; columns of words are on the left of their column, numbers on the right."""
    from matplotlib.table import Table as Drawing
    from matplotlib.transforms import Bbox

    cells = [[entry_text(entry, table.digits) for entry in row] for row in table.rows]
    widths = [max(len(str(c)) for c in column) + 2 for column in zip(table.columns, *cells, strict=True)]
    words = [any(isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]
    figure = new_figure(
        max(6.0, 0.085 * sum(widths)), 0.24 * (len(cells) + 1) + 0.17 * len(table.notes) + 0.7
    )
    axes = figure.add_subplot()
    axes.axis("off")
    axes.set_title(table.title, loc="left", fontsize=11)
    drawn = Drawing(axes, bbox=Bbox.unit())
    drawn.auto_set_font_size(False)
    for number, texts in enumerate([table.columns, *cells]):
        for column, text in enumerate(texts):
            cell = drawn.add_cell(
                number, column, widths[column] / sum(widths), 1.0, text=text,
                loc="left" if words[column] else "right",
            )  # fmt: skip
            cell.visible_edges = "horizontal"
            cell.set(linewidth=0.4, fontsize=9)
            cell.set_text_props(weight="bold" if number == 0 else "normal")
    axes.add_table(drawn)
    if table.notes:
        figure.supxlabel("\n".join(table.notes), fontsize=8, x=0.01, ha="left")
    return figure


def write_table(folder: Path, table: Table) -> list[Path]:
    """Write a table as .csv, .tex and .png. Raises MapFileError."""
    paths = [folder / f"{table.name}{suffix}" for suffix in (".csv", ".tex", ".png")]
    write_text(paths[0], as_csv(table))
    write_text(paths[1], as_latex(table))
    with atomic_path(paths[2]) as temporary:
        as_figure(table).savefig(temporary, dpi=130)
    return paths


def _escaped(text: str) -> str:
    return text.translate(_LATEX)


def _has_deviation(entry: Entry) -> bool:
    return isinstance(entry, Spread) and entry.deviation is not None
