"""``eval window``: a window takes less memory, and its folder holds the map that has none."""

from pathlib import Path

import pytest
from small_scenes import experiment

from taichi_mrf.experiments import window

pytest.importorskip("zarr", reason="a window needs the extra store")
pytestmark = pytest.mark.usefixtures("one_backend")


def test_a_window_takes_less_memory_for_the_same_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "EVERY", 8)
    monkeypatch.setattr(window, "SCENE", "synthetic:corridor?rooms=12&width=32&height=24")
    reports: list[str] = []
    options = {"voxel_sizes": (0.1,), "seeds": (0,), "limit": 24}
    chosen = experiment(
        tmp_path, tmp_path / "out", **options, report=lambda what, done, total: reports.append(what)
    )
    (memory, equal), paths = window.run_window(chosen)
    assert [row[1] for row in memory.rows] == [8, 16, 24]
    within, few, frozen, none = memory.rows[-1][2:6]
    assert max(within, few) < frozen < none
    assert all(row[7] > 0 for row in memory.rows)
    same, kept, in_full = equal.rows
    assert same[1:] == [window.FROZEN, same[2], 100.0, 100.0, pytest.approx(0.0, abs=1e-6)]
    assert same[2] > 100_000
    assert kept[3] > 80
    assert in_full[3] > 80
    assert {path.suffix for path in paths} == {".csv", ".tex", ".png"}
    assert all(path.stat().st_size > 100 for path in paths)
    # What was measured once is not measured again.
    before = len(reports)
    window.run_window(chosen)
    assert len(reports) == before + 1
