"""The readings' experiment on small scenes: the rays' vote answers more rays rightly than marginals, and
a calibrated map has more of the surface."""

from pathlib import Path

import pytest
from small_scenes import make_data

from taichi_mrf.experiments import readings
from taichi_mrf.experiments.run import run_experiment

pytestmark = pytest.mark.usefixtures("one_backend")


def test_readings_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = make_data(tmp_path)
    monkeypatch.setattr(readings, "CORRELATIONS", (1.0,))
    monkeypatch.setattr(readings, "LEAST_IN_BIN", 5)
    [table, trust], paths = run_experiment("readings", data, tmp_path, (0.1,), (0,), 4, lambda *_: None)
    assert all(path.is_file() for path in paths)
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    assert len(rows) == 4 * 7  # two houses, the coffin scene, the room, and three of them turned
    names = ["omega", "marginal", "surface", "calibrated"]
    for omega, marginal, surface, calibrated in zip(*(rows[i::4] for i in range(4)), strict=True):
        assert [each["reading"] for each in (omega, marginal, surface, calibrated)] == names
        assert surface["recall"] >= marginal["recall"]
        assert surface["unanswered"] <= marginal["unanswered"]
        assert surface["1.5sigma"] >= marginal["1.5sigma"]
    rows = [dict(zip(trust.columns, row, strict=True)) for row in trust.rows]
    for seen, all_, calibrated in zip(rows[::4], rows[1::4], rows[2::4], strict=True):
        assert (seen["judged"], all_["judged"], calibrated["reading"]) == ("seen", "all", "calibrated")
        assert all_["recall"] == seen["recall"]
        assert all_["precision"] <= seen["precision"]
        assert calibrated["recall"] > seen["recall"]
