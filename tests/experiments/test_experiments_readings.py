"""The readings' experiment on small scenes: the rays' vote answers more rays rightly than marginals."""

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
    [table, marginals], paths = run_experiment("readings", data, tmp_path, (0.1,), (0,), 4, lambda *_: None)
    assert all(path.is_file() for path in paths)
    assert len(marginals.rows) == 4  # two houses, the coffin scene, the room
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    for omega, marginal, surface in zip(rows[::3], rows[1::3], rows[2::3], strict=True):
        assert [each["reading"] for each in (omega, marginal, surface)] == ["omega", "marginal", "surface"]
        assert surface["recall"] >= marginal["recall"]
        assert surface["unanswered"] <= marginal["unanswered"]
        assert surface["1.5sigma"] >= marginal["1.5sigma"]
