"""The price of dated evidence where nothing changes: little for an endless half-life, much for none."""

from pathlib import Path

import numpy as np
import pytest
from small_scenes import make_data

from taichi_mrf.config.time import TimeConfig
from taichi_mrf.experiments import price
from taichi_mrf.experiments.run import run_experiment

pytestmark = pytest.mark.usefixtures("one_backend")


def test_the_price_grows_with_what_is_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = make_data(tmp_path)
    monkeypatch.setattr(price, "DATED", {"endless": TimeConfig(1e12), "at once": TimeConfig(1e-3)})
    monkeypatch.setattr(price, "HELD_OUT", dict.fromkeys(price.HELD_OUT, 3))
    [table], paths = run_experiment("price", data, tmp_path, (0.1,), (0,), None, lambda *_: None)
    assert len(table.rows) == 6
    assert all(path.is_file() for path in paths)
    endless, at_once = table.rows[::2], table.rows[1::2]
    assert {row[2] for row in endless} == {"endless"}
    moved, forgotten = (
        np.abs(np.array([row[3:6] for row in rows], float)).sum() for rows in (endless, at_once)
    )
    assert moved < 0.2 * forgotten
    assert sum(float(row[6]) for row in at_once) < sum(float(row[6]) for row in endless)
