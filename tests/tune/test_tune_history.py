"""The table of tries, as numbers and as files."""

import csv
import dataclasses
import io
from pathlib import Path

import pytest

from taichi_mrf.config.schema import Config, SensorConfig, load
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.tune.history import History
from taichi_mrf.viewer.tune.messages import Scores, Tried
from taichi_mrf.viewer.tune.panel import table_html
from taichi_mrf.viewer.tune.plots import score_board_html, sparkline_svg

SCORES = Scores(0.5, 0.9, 0.8, 0.01, 0.02, 0.1, 1.25, 0.03, float("nan"), 2.5, 70_000, 8)
FIRST = Config(voxel_size=0.1)
OTHER = dataclasses.replace(
    FIRST, inference=InferenceConfig(sweeps=5), sensor=SensorConfig(sigma=(0.01, 0.0, 0.002))
)


def history() -> History:
    made = History("a kitchen")
    made.note(FIRST, SCORES, "start")
    made.note(OTHER, dataclasses.replace(SCORES, log_likelihood=1.5), "search")
    return made


def test_the_same_parameters_are_the_same_try_with_the_finer_scores() -> None:
    made = history()
    coarse = dataclasses.replace(SCORES, pixel_stride=4, accuracy_5cm=0.7)
    assert made.note(FIRST, coarse, "hand").scores == SCORES
    third = dataclasses.replace(FIRST, voxel_size=0.05)
    assert made.note(third, coarse, "hand").number == 2
    assert made.note(third, SCORES, "hand").scores == SCORES
    assert [each.number for each in made.attempts] == [0, 1, 2]


def test_only_a_try_that_there_is_can_be_pinned() -> None:
    made = history()
    made.pin(1)
    assert made.pinned == 1
    for number in (-1, 2):
        with pytest.raises(ConfigError, match=f"there is no try {number}"):
            made.pin(number)


def test_the_yaml_reads_back_as_the_very_parameters(tmp_path: Path) -> None:
    name, text = history().file("yaml", 1)
    (tmp_path / name).write_text(text)
    assert load(tmp_path / name) == OTHER
    head = text[: text.index("\n\n")]
    assert all(line.startswith("#") for line in head.splitlines())
    for said in ("try 1 of a kitchen", "inference.sweeps: 5 (was 3)", "log-likelihood: +1.500", "80.0 %"):
        assert said in head


def test_the_source_cannot_break_out_of_the_comment(tmp_path: Path) -> None:
    made = History("a\nvoxel_size: 7")
    made.note(FIRST, SCORES, "start")
    name, text = made.file("yaml", 0)
    (tmp_path / name).write_text(text)
    assert load(tmp_path / name) == FIRST


def test_the_csv_has_a_line_for_each_try_with_what_differs() -> None:
    made = history()
    made.pin(1)
    name, text = made.file("csv", 0)
    assert name == "tries.csv"
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["inference.sweeps"] for row in rows] == ["3", "5"]
    assert rows[1]["sensor.sigma"] == "0.01 0.0 0.002"
    assert [row["reference"] for row in rows] == ["0", "1"]
    assert float(rows[1]["log_likelihood"]) == 1.5
    assert "voxel_size" not in rows[0]


def tries() -> list[Tried]:
    return [each.message() for each in history().attempts]


def test_the_board_tells_how_a_try_differs_from_the_reference() -> None:
    board = score_board_html(tries(), shown=1, pinned=0)
    assert "Try 1" in board
    assert "+1.500" in board
    assert "+0.250" in board
    assert "better ▲" in board
    assert "calibration" not in board
    rest = score_board_html(tries(), 1, 0, first=False)
    assert "calibration, depth ↓" in rest
    assert "calibration, voxels" not in rest  # there is no truth
    assert "no scores yet" in score_board_html([], None, None)


def test_voxels_of_another_size_are_compared_in_centimetres() -> None:
    coarse = dataclasses.replace(FIRST, voxel_size=2 * FIRST.voxel_size)
    right = dataclasses.replace(SCORES, accuracy_sigma=0.99, accuracy_5cm=SCORES.accuracy_5cm - 0.125)
    several = [*tries(), Tried(2, coarse, right, "hand")]
    board = score_board_html(several, shown=2, pinned=0)
    assert "right, 5 cm" in board
    assert "worse ▼ -12.5" in board
    assert "1.5 voxels" not in board
    rest = score_board_html(several, shown=2, pinned=0, first=False)
    row = rest.partition("right, 1.5 voxels")[2].partition("</tr>")[0]
    assert "99.0 %" in row
    assert "other voxels" in row
    assert "better" not in row
    assert "99.0 %" not in table_html(several, 2, 0)


def test_a_sparkline_has_a_point_for_each_value_that_there_is() -> None:
    drawn = sparkline_svg([1.0, float("nan"), 3.0, 2.0], shown=3, reference=1.0)
    assert drawn.count(",") == 3
    assert "circle" in drawn
    assert "circle" not in sparkline_svg([1.0, float("nan"), 3.0, 2.0], shown=1, reference=1.0)
    assert sparkline_svg([float("nan")], 0, float("nan")) == ""


def test_the_table_shows_the_newest_first_and_escapes_what_it_is_given() -> None:
    text = table_html(tries(), shown=1, pinned=0)
    assert text.index("<b>1</b>") < text.index("<b>0</b>")
    assert "sweeps 5" in text
    table = dataclasses.replace(FIRST, sensor=SensorConfig(sigma_table="<b>.npy"))
    evil = Tried(2, table, SCORES, "hand")
    assert "&lt;b&gt;" in table_html([*tries(), evil], 2, 0)
