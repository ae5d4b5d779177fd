"""Fills the tables of README.md and of four pages of docs with the figures of docs/results.

    python docs/result_tables.py

A table whose columns are those of a file gets the file's figures, row by row. As many first columns as tell
the rows of a file apart name a row; which rows a page shows is the page's choice.
"""

import csv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
DOCS = ("evaluation.md", "benchmarks.md", "own_robot.md", "performance.md", "free.md")
PAGES = (ROOT / "README.md", *(ROOT / "docs" / name for name in DOCS))
BEST_IS_LARGEST = ("peers", "lidar_points")
"""Files whose largest figure of a column is bold, among the rows that differ in the last name alone."""

Rows = dict[tuple[str, ...], list[str]]
"""The figures of a table by the names of a row."""


def main() -> None:
    """Write the pages."""
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")


def filled(text: str) -> str:
    """A page with the figures of the files. Raises KeyError for a row that a file lacks."""
    tables = {tuple(columns): rows for columns, rows in map(shown, sorted(RESULTS.glob("*.csv")))}
    lines: list[str] = []
    rows: Rows = {}
    for line in text.splitlines():
        cells = cells_of(line)
        if not cells:
            rows = {}
        elif tuple(cells) in tables:
            rows = tables[tuple(cells)]
        elif rows and not cells[0].startswith("---"):
            key = tuple(cells[: len(next(iter(rows)))])
            line = row_of([*key, *rows[key]])
        lines.append(line)
    return "\n".join(lines) + "\n"


def shown(path: Path) -> tuple[list[str], Rows]:
    """A file's columns and its rows, as pages show them."""
    columns, rows = read(path)
    if path.stem not in BEST_IS_LARGEST:
        return columns, rows
    best: dict[tuple[tuple[str, ...], int], float] = {}
    for key, figures in rows.items():
        for i, figure in enumerate(figures):
            if figure != "-":
                best[key[:-1], i] = max(best.get((key[:-1], i), float("-inf")), float(figure))

    def marked(key: tuple[str, ...], i: int, figure: str) -> str:
        return f"**{figure}**" if figure != "-" and float(figure) == best[key[:-1], i] else figure

    return columns, {key: [marked(key, i, each) for i, each in enumerate(rows[key])] for key in rows}


def read(path: Path) -> tuple[list[str], Rows]:
    """The columns of a file and its rows. Raises StopIteration if two rows are the same."""
    with path.open(newline="", encoding="utf-8") as file:
        columns, *rows = csv.reader(file)
    names = next(n for n in range(1, len(columns)) if len({tuple(row[:n]) for row in rows}) == len(rows))
    return columns, {tuple(row[:names]): row[names:] for row in rows}


def write(path: Path, columns: list[str], rows: Rows) -> None:
    """Write such a file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *([*key, *rows[key]] for key in rows)])


def cells_of(line: str) -> list[str]:
    """The cells of a line of a table, none of any other line."""
    cells = line.removeprefix("|").removesuffix("|").split("|") if line.startswith("|") else []
    return [cell.strip() for cell in cells]


def row_of(cells: list[str]) -> str:
    """A line of a table."""
    return f"|{'|'.join(f' {cell} ' if cell else ' ' for cell in cells)}|"


if __name__ == "__main__":
    main()
