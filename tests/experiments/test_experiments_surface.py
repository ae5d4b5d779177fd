"""``eval surface`` on a small room, with a stand-in for Open3D that gives a surface of its own."""

from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.experiments import surface
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.ledger import Ledger


class _Wall:
    """One triangle far from the room, whatever is fused."""

    def __init__(self, scene: object, voxel_size: float, truncation: float, images: int) -> None:
        self.images = images
        # So many that the largest truncation is left out.
        self.blocks = surface.MOST_BLOCKS if truncation == max(surface.TRUNCATIONS) else 1

    def fuse(self, images: list) -> float:
        assert len(images) == self.images
        return 2.0

    def mesh(self, least_weight: float) -> surface.Mesh:
        assert self.blocks < surface.MOST_BLOCKS
        return np.array([[50.0, 0, 0], [51, 0, 0], [50, 1, 0]]), np.array([[0, 1, 2]]), None


def test_each_surface_has_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface, "ROOM", "synthetic:room?frames=4&width=80&height=60&noise=none")
    monkeypatch.setattr(surface, "Open3DGrid", _Wall)
    cases = [surface._Case("room", lambda: surface.room_scene(None, 0))]
    monkeypatch.setattr(surface, "_cases", lambda experiment: cases)
    chosen = Experiment(tmp_path, tmp_path, Ledger(tmp_path / "surface.jsonl", {}), (0.1,), (0,))
    (table,), paths = surface.run_surface(chosen)
    assert [row[2] for row in table.rows] == [
        surface.SURFACE,
        surface.MARGINAL,
        "Open3D, 4 voxels, weight 1",
    ]
    f_5cm = [float(row[4]) for row in table.rows]
    assert f_5cm[0] > max(0.3, f_5cm[1])
    assert f_5cm[2] == 0.0
    assert float(table.rows[2][-1]) > 2.0
    assert all(path.exists() for path in paths)
