"""Fills tables of README.md and docs/evaluation.md with the figures of docs/results.

    python docs/result_tables.py

A table whose columns are those of a file in docs/results gets the file's figures, row by row. The first three
columns name a row; which rows a page shows is the page's choice. Bold is the best of a scene, a voxel size
and a column.
"""

import csv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = (ROOT / "README.md", ROOT / "docs" / "evaluation.md")
KEY = 3
"""As many columns name a row; all but the last of them name what is compared."""

Rows = dict[tuple[str, ...], list[str]]
"""The figures of a table by the names of a row."""


def main() -> None:
    """Write the pages."""
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")


def filled(text: str) -> str:
    """A page with the figures of the files. Raises KeyError for a row that a file lacks."""
    tables = {tuple(columns): rows for columns, rows in map(shown, sorted(RESULTS.glob("*.csv")))}
    lines, rows = [], None
    for line in text.splitlines():
        cells = cells_of(line)
        if not cells:
            rows = None
        elif tuple(cells) in tables:
            rows = tables[tuple(cells)]
        elif rows is not None and not cells[0].startswith("---"):
            line = row_of([*cells[:KEY], *rows[tuple(cells[:KEY])]])
        lines.append(line)
    return "\n".join(lines) + "\n"


def shown(path: Path) -> tuple[list[str], Rows]:
    """A file's columns and its rows, as pages show them."""
    columns, rows = read(path)
    best: dict[tuple[str, ...], float] = {}
    for key, figures in rows.items():
        for column, figure in zip(columns[KEY:], figures, strict=True):
            place = (*key[:-1], column)
            if figure != "-":
                best[place] = max(best.get(place, float("-inf")), float(figure))

    def marked(key: tuple[str, ...], column: str, figure: str) -> str:
        is_best = figure != "-" and float(figure) == best[(*key[:-1], column)]
        return f"**{figure}**" if is_best else figure

    return columns, {
        key: [marked(key, *each) for each in zip(columns[KEY:], figures, strict=True)]
        for key, figures in rows.items()
    }


def read(path: Path) -> tuple[list[str], Rows]:
    """The columns of a file and its rows."""
    with path.open(newline="", encoding="utf-8") as file:
        columns, *rows = csv.reader(file)
    return columns, {tuple(row[:KEY]): row[KEY:] for row in rows}


def write(path: Path, columns: list[str], rows: Rows) -> None:
    """Write such a file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *([*key, *rows[key]] for key in rows)])


def cells_of(line: str) -> list[str]:
    """The cells of a line of a table, none of any other line."""
    return [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []


def row_of(cells: list[str]) -> str:
    """A line of a table."""
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
