"""``eval lidar`` on small scenes: a room whose walls are known, scanned from six places."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from point_clouds import write_pcd
from small_scenes import experiment

from taichi_mrf.evaluation.tables import Table
from taichi_mrf.experiments import lidar, lidar_rivals, lidar_roc, tuning
from taichi_mrf.experiments.lidar_rivals import tuned_parameters
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.methods.wavemap.plug import WavemapConfig
from taichi_mrf.sensor.ray_table import RayTable

pytestmark = pytest.mark.usefixtures("one_backend")

HALF_M = np.array([2.9, 2.1, 1.3])


def scans(seed: int, rays: int) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Points (N, 3) in the sensor's frame, with 2 cm of noise, and where the sensor is. It is not turned."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(6):
        place = rng.uniform(-0.5, 0.5, 3)
        ways = rng.normal(size=(rays, 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        range_m = ((np.copysign(HALF_M, ways) - place) / ways).min(axis=1)
        found.append((ways * (range_m + rng.normal(0, 0.02, rays))[:, None], place))
    return found


def write_building(folder: Path) -> None:
    """Scans of the room in the layout of the real ones."""
    folder.mkdir(parents=True)
    poses = np.tile(np.eye(4), (6, 1, 1))
    for number, (points, place) in enumerate(scans(0, 1500)):
        poses[number, :3, 3] = place
        np.savez(folder / f"scan-{number:03d}.npz", xyz_2mm=np.round(points / 0.002).astype(np.int16))
    np.savez(folder / "poses.npz", scan=np.arange(6), T_world_lidar=poses, stamp_s=np.arange(6.0))


def write_structured(folder: Path) -> None:
    """Scans of the room in the layout of la3dm's: points in the world's frame, and VIEWPOINT."""
    folder.mkdir(parents=True)
    for number, (points, place) in enumerate(scans(1, 400), start=1):
        T_world_sensor = np.eye(4)
        T_world_sensor[:3, 3] = place
        write_pcd(folder / f"sim_{number}.pcd", points + place, T_world_sensor=T_world_sensor)


def test_a_building_is_mapped_by_all_contenders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lidar, "LIDAR_SIGMA_M", 1.0)  # that of the scans is 2 cm
    for module in (tuning, lidar_roc):
        monkeypatch.setattr(module, "GRID", tuning.GRID[:2])
    monkeypatch.setattr(lidar_roc, "SIGMAS_M", (0.02,))
    monkeypatch.setattr(lidar_roc, "FOLDS", 2)
    monkeypatch.setattr(lidar_rivals, "BOUNDS", dict.fromkeys(lidar_rivals.BOUNDS, (0.05, 0.3)))
    write_building(tmp_path / "lidar_building")
    write_structured(tmp_path / "la3dm_structured")
    reports: list[str] = []
    options = {"voxel_sizes": (0.2,), "seeds": (0,)}
    chosen = experiment(
        tmp_path, tmp_path / "out", **options, report=lambda what, done, total: reports.append(what)
    )
    (table, areas), paths = lidar.run_lidar(chosen)
    names = [str(row[1]) for row in table.rows]
    assert names[0] == "MRFMap"
    rivals = {"OctoMap-style", "log-odds per ray", "wavemap-style"}
    assert {name.split(",")[0] for name in names} == {"MRFMap"} | rivals
    mrf = table.rows[0]
    assert mrf[2].mean > 0.9  # within 1.5 voxels
    assert mrf[3].mean > 0.8  # within 20 cm
    assert mrf[6].mean < 0.1
    learnt = re.search(r"5 scans mapped, 1 held out. Learnt sigma: ([\d.]+) cm for vox", table.notes[1])
    assert learnt is not None
    assert 1 < float(learnt[1]) < 20
    assert "Tuned: 20 cm: " in table.notes[2]
    assert {path.name for path in paths} == {
        f"{name}{suffix}" for name in ("lidar", "lidar_roc") for suffix in (".csv", ".tex", ".png")
    }
    check_areas(areas, rivals)
    before = len(chosen.ledger.done)
    again, _ = lidar.run_lidar(chosen)
    assert [each.rows for each in again] == [table.rows, areas.rows]
    assert len(chosen.ledger.done) == before


def check_areas(areas: Table, rivals: set[str]) -> None:
    by_name = {str(row[1]): row for row in areas.rows}
    assert len(by_name) == len(areas.rows)
    assert {name.split(",")[0] for name in by_name} == {"MRFMap", lidar_roc.KERNEL} | rivals
    assert {name for name in by_name if "MRFMap" in name} == {
        f"MRFMap, {each}" for each in lidar_roc.READINGS
    }
    for row in areas.rows:
        assert 0 <= row[4].mean < 1  # unknown of the measured points
        assert 0.5 < row[2].mean <= 1
    assert by_name["MRFMap, marginal"][2].mean > 0.75
    assert by_name["MRFMap, marginal"][3].mean > 0.9
    assert sum("fold" in note for note in areas.notes) == lidar_roc.FOLDS + 1


class Slab:
    """Stands in for a map: occupied from x = 1 to x = 2, free in front of it, unknown behind."""

    voxel_size = 0.1

    def occupancy(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        x = points[:, 0]
        return np.where(x < 1, 0.1, np.where(x < 2, 0.9, 0.5)).astype(np.float32)

    def state(self, points: NDArray[np.float64]) -> NDArray[np.int8]:
        return np.where(points[:, 0] < 2, 1, 0).astype(np.int8)


def facing(range_m: list[float]) -> SceneView:
    """Rays along x, one of which measured nothing, from (0.2, 0, 0)."""
    depth = np.array([range_m], np.float32)
    T = look_at([0.2, 0.0, 0.0], [5.0, 0.0, 0.0])
    rays = RayTable(np.tile(T[:3, :3].T @ [1.0, 0.0, 0.0], (len(range_m), 1)))
    return SceneView("scan", T, depth, depth, depth > 0, camera=rays)


def test_points_of_a_scan_are_what_it_measured_and_what_is_in_front() -> None:
    view = facing([1.3] * 300 + [0.0, 0.1])
    occupied, free = lidar_roc.points_of(view, 0.2, seed=3)
    np.testing.assert_allclose(occupied, [[1.5, 0, 0]] * 300 + [[0.3, 0, 0]], atol=1e-6)
    assert len(free) == 300  # of the ray of 10 cm nothing is 20 cm in front of its end
    np.testing.assert_allclose(free[:, 1:], 0, atol=1e-6)
    shares = (free[:, 0] - 0.2) / 1.1
    np.testing.assert_allclose(
        np.quantile(shares, [0, 0.25, 0.5, 0.75, 1]), [0, 0.25, 0.5, 0.75, 1], atol=0.1
    )
    assert (shares.min() >= 0) & (shares.max() <= 1)
    np.testing.assert_array_equal(lidar_roc.points_of(view, 0.2, seed=3)[1], free)


def test_a_point_that_is_unknown_counts_with_the_prior() -> None:
    figures = lidar_roc.scan_figures(Slab(), Slab(), facing([1.3, 1.3, 2.3, 2.3]), seed=0)
    gap = lidar_roc.DIAGONAL * 0.1
    _, free = lidar_roc.points_of(facing([1.3, 1.3, 2.3, 2.3]), gap, seed=0)
    p = Slab().occupancy(np.concatenate([[[1.5, 0, 0]] * 2 + [[2.5, 0, 0]] * 2, free]))
    wins = [(a > b) + 0.5 * (a == b) for a in p[:4] for b in p[4:]]
    assert figures["area"] == np.mean(wins)
    known = p != 0.5
    truth = np.arange(len(p)) < 4
    assert figures["crossed"] == np.mean(
        [(a > b) + 0.5 * (a == b) for a in p[known & truth] for b in p[known & ~truth]]
    )
    assert figures["occupied"] == 0.5
    assert figures["free"] == np.mean(free[:, 0] >= 2)


@pytest.mark.parametrize("beams", ["neighbours", "nearest", "ray"])
@pytest.mark.parametrize("voxel_size", [0.2, 0.05])
def test_wavemaps_parameters_are_chosen_by_their_score_alone(voxel_size: float, beams: str) -> None:
    tried: list[WavemapConfig] = []
    nothing = np.zeros((1, 1), np.float32)
    view = SceneView("", np.eye(4), nothing, nothing, nothing > 0)
    scene = Scene("", RayTable([[1.0, 0, 0]]), lidar.PolynomialNoise((0.1,)), lidar.VolumeConfig(), 1, [view])
    best = {
        "angle_sigma_deg": 8 * 0.035,
        "range_sigma": 0.25 * WavemapConfig().range_sigma_at(voxel_size),
        "scaling_free": 0.1,
        "scaling_occupied": 0.8,
    }

    def score(contender: lidar.Contender) -> float:
        config = contender.make(scene, voxel_size).config.wavemap
        tried.append(config)
        off = sum(abs(np.log(getattr(config, name) / value)) for name, value in best.items())
        return float((config.beams == beams) - off)

    found = tuned_parameters(voxel_size, score)
    for name, value in best.items():
        assert getattr(found, name) == pytest.approx(value, abs=1e-4)
    assert found.beams == beams
    # The published parameters are where it begins.
    assert tried[0].range_sigma == WavemapConfig().range_sigma_at(voxel_size)
    assert WavemapConfig() in [replace(each, range_sigma=0.0) for each in tried[:2]]
    for config in tried:
        for name, (least, most) in lidar_rivals.BOUNDS.items():
            assert least <= getattr(config, name) <= most
