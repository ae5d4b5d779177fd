"""``eval lidar`` on a small building: a room whose walls are known, scanned from six places."""

from pathlib import Path

import numpy as np
import pytest
from small_scenes import experiment

from taichi_mrf.experiments import lidar, tuning

pytestmark = pytest.mark.usefixtures("one_backend")

HALF_M = np.array([2.9, 2.1, 1.3])


def write_building(folder: Path) -> None:
    """Scans of the room with 2 cm of noise, in the layout of the real ones."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (6, 1, 1))
    for number in range(6):
        poses[number, :3, 3] = rng.uniform(-0.5, 0.5, 3)
        rays = rng.normal(size=(1500, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        range_m = ((np.copysign(HALF_M, rays) - poses[number, :3, 3]) / rays).min(axis=1)
        points = rays * (range_m + rng.normal(0, 0.02, 1500))[:, None]
        np.savez(folder / f"scan-{number:03d}.npz", xyz_2mm=np.round(points / 0.002).astype(np.int16))
    np.savez(folder / "poses.npz", scan=np.arange(6), T_world_lidar=poses, stamp_s=np.arange(6.0))


def test_a_building_is_mapped_by_all_contenders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lidar, "SIGMAS_M", (0.02, 0.5))
    monkeypatch.setattr(tuning, "GRID", tuning.GRID[:2])
    write_building(tmp_path / "lidar_building")
    reports: list[str] = []
    options = {"voxel_sizes": (0.2,), "seeds": (0,)}
    chosen = experiment(
        tmp_path, tmp_path / "out", **options, report=lambda what, done, total: reports.append(what)
    )
    (table,), paths = lidar.run_lidar(chosen)
    names = [str(row[1]) for row in table.rows]
    assert names[0] == "MRFMap"
    assert {name.split(",")[0] for name in names} == {"MRFMap", "OctoMap-style", "log-odds per ray"}
    mrf = table.rows[0]
    assert mrf[2].mean > 0.9  # within 1.5 voxels
    assert mrf[3].mean > 0.8  # within 20 cm
    assert mrf[6].mean < 0.1
    assert "5 scans mapped, 1 held out. Learnt sigma: 2 cm for voxels of 20 cm" in table.notes[1]
    assert {path.suffix for path in paths} == {".csv", ".tex", ".png"}
    before = len(chosen.ledger.done)
    again, _ = lidar.run_lidar(chosen)
    assert again[0].rows == table.rows
    assert len(chosen.ledger.done) == before
