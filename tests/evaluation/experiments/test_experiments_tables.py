"""Tables of results: what is written is what was found, in every form."""

import csv
import io
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.errors import MapFileError
from taichi_mrf.evaluation.experiments.folds import Scored
from taichi_mrf.evaluation.experiments.tuning import COLUMNS, score_table
from taichi_mrf.evaluation.tables import (
    Entry,
    Spread,
    Table,
    as_csv,
    as_figure,
    as_latex,
    entry_text,
    write_table,
)

TABLE = Table(
    "some_table",
    "Some title",
    ["map", "score", "100% & more_or_less", "count"],
    [
        ["A_b & 50%", Spread(1 / 3, 1 / 7), 2 / 3, 4],
        ["#1 {x} $y$ ~z^2 \\", Spread(0.25), None, 0],
        ["no view", Spread(math.nan), math.nan, None],
    ],
    ["How to read it.", "And 5% more."],
)
finite = st.floats(min_value=-1e6, max_value=1e6)


@given(st.lists(finite, min_size=2, max_size=30))
def test_a_spread_is_mean_and_sample_deviation(values: list[float]) -> None:
    spread = Spread.of([None, *values, math.nan, math.inf])
    assert spread.mean == pytest.approx(np.mean(values), rel=1e-9, abs=1e-6)
    assert spread.deviation == pytest.approx(np.std(values, ddof=1), rel=1e-9, abs=1e-6)


def test_one_value_has_no_spread_and_none_no_mean() -> None:
    assert Spread.of([None, 0.5]) == Spread(0.5, None)
    for nothing in ([], [None], [math.nan]):
        spread = Spread.of(nothing)
        assert math.isnan(spread.mean)
        assert spread.deviation is None


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        (None, "-"),
        (math.nan, "-"),
        (math.inf, "-"),
        (Spread(math.nan), "-"),
        (Spread(0.12345), "0.123"),
        (Spread(0.12345, 0.0678), "0.123 ± 0.068"),
        (0.5, "0.500"),
        (-2.0, "-2.000"),
        (7, "7"),
        ("5 cm", "5 cm"),
    ],
)
def test_what_is_printed(entry: Entry, text: str) -> None:
    assert entry_text(entry, 3) == text


def test_csv_keeps_every_digit() -> None:
    rows = list(csv.reader(io.StringIO(as_csv(TABLE))))
    assert rows[0] == ["map", "score", "score (std)", "100% & more_or_less", "count"]
    assert rows[1] == ["A_b & 50%", repr(1 / 3), repr(1 / 7), repr(2 / 3), "4"]
    assert [float(text) for text in rows[1][1:4]] == [1 / 3, 1 / 7, 2 / 3]
    assert rows[2] == [TABLE.rows[1][0], "0.25", "", "", "0"]
    assert rows[3] == ["no view", "nan", "", "nan", ""]


def test_latex_has_a_cell_for_every_column() -> None:
    text = as_latex(TABLE)
    lines = text.splitlines()
    assert lines[0] == r"\begin{tabular}{lrrr}"
    assert lines[1] == r"\toprule"
    assert lines[3] == r"\midrule"
    rows = [line for line in lines if line.endswith(r" \\")]
    assert len(rows) == 1 + len(TABLE.rows)
    for row in rows:
        assert len(re.findall(r"(?<!\\)&", row)) == len(TABLE.columns) - 1
        assert re.search(r"(?<!\\)[%_#]", row) is None
        assert row.count("{") == row.count("}")
    assert r"A\_b \& 50\% & 0.333 $\pm$ 0.143 & 0.667 & 4 \\" in rows
    assert (
        r"\#1 \{x\} \$y\$ \textasciitilde{}z\textasciicircum{}2 \textbackslash{} & 0.250 & - & 0 \\" in rows
    )
    assert lines[-4:-2] == [r"\bottomrule", r"\end{tabular}"]
    assert lines[-2:] == [f"% {note}" for note in TABLE.notes]


def test_digits_are_those_of_the_table() -> None:
    table = Table("t", "", ["a", "b"], [["x", 1 / 3]], digits=5)
    assert r"x & 0.33333 \\" in as_latex(table)


def test_the_picture_shows_every_cell() -> None:
    figure = as_figure(TABLE)
    (axes,) = figure.axes
    shown = {place: cell.get_text().get_text() for place, cell in axes.tables[0].get_celld().items()}
    assert [shown[0, column] for column in range(4)] == TABLE.columns
    for number, row in enumerate(TABLE.rows, start=1):
        assert [shown[number, column] for column in range(4)] == [entry_text(entry, 3) for entry in row]
    assert axes.get_title(loc="left") == "Some title"
    assert figure.get_supxlabel() == "How to read it.\nAnd 5% more."


def test_a_table_is_three_files(tmp_path: Path) -> None:
    paths = write_table(tmp_path, TABLE)
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    assert [path.name for path in paths] == ["some_table.csv", "some_table.tex", "some_table.png"]
    assert paths[0].read_text() == as_csv(TABLE)
    assert paths[1].read_text() == as_latex(TABLE)
    picture = cv2.imread(str(paths[2]))
    assert picture is not None
    assert picture.min() < 50 < 250 < picture.max()


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"no/some_table\.csv: cannot be written"):
        write_table(tmp_path / "no", TABLE)


def scored(row: str, size: float, value: float, **figures: float | None) -> Scored:
    return Scored(row, size, 0, "view", dict.fromkeys(COLUMNS, value) | figures, build_seconds=value)


def test_scores_become_rows_beside_the_paper() -> None:
    entries = [
        scored("A, all", 0.02, 0.2),
        scored("A, all", 0.05, 0.4),
        scored("A, all", 0.05, 0.8, rms=math.nan),
        scored("B", 0.05, 0.1),
    ]
    paper = {("A, all", 0.05): Spread(0.9, 0.01), ("B", 0.01): Spread(0.3), ("A", 0.02): Spread(0.7)}
    table = score_table("t", "T", entries, paper, ["a note"])
    assert table.columns == ["voxels", "map", *COLUMNS.values(), "paper", "map (s)", "views"]
    assert table.notes[-1] == "a note"
    by_name = {tuple(row[:2]): dict(zip(table.columns, row, strict=True)) for row in table.rows}
    assert list(by_name) == [("5 cm", "A, all"), ("5 cm", "B"), ("2 cm", "A, all")]
    both = by_name["5 cm", "A, all"]
    assert both["5cm"] == Spread.of([0.4, 0.8])
    assert both["RMS error (m)"] == Spread(0.4)
    assert both["paper"] == Spread(0.9, 0.01)
    assert both["map (s)"] == Spread(Spread.of([0.4, 0.8]).mean)
    assert both["views"] == 2
    assert by_name["5 cm", "B"]["paper"] is None
    assert by_name["2 cm", "A, all"]["paper"] is None
