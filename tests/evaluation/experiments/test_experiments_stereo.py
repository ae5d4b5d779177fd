"""The stereo experiment: its measure against brute force, its curves by hand, all of it on a made street."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import row_of, write_image, write_rows
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from stereo_scene import Layer, render

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.evaluation.artefacts import LEAST_RAYS, SIGMAS, Sightings, sightings
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Ledger
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.evaluation.experiments.stereo import maps as stereo
from taichi_mrf.evaluation.experiments.stereo.growth import (
    artefacts_at,
    corridor_scene,
    curve,
    grow,
    threshold_for,
    updates_to,
)
from taichi_mrf.evaluation.experiments.stereo.maps import log_likelihood, ratio
from taichi_mrf.evaluation.experiments.stereo.street import (
    RECORDING,
    Row,
    mrf_of_street,
    octomap_style,
    street_scene,
    thinned,
    visibility,
    visibility_at_once,
)
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

CAMERA = PinholeCamera(7, 5, 6.0, 6.5, 3.2, 1.9)
SIZE = 0.5
SIGMA = (0.02, 0.0, 0.004)
MAX_DEPTH = 6.0


@dataclass
class FixedMap:
    """Just as much of a map as the measure asks for."""

    centres: NDArray[np.float64]
    probability: NDArray[np.float32]
    voxel_size: float = SIZE

    @property
    def marginals(self) -> "FixedMap":
        return self

    def voxels(self, min_probability: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        keep = self.probability >= min_probability
        return self.centres[keep], self.probability[keep]


def seen_by(m: OccupancyMap, scene: Scene, views: Sequence[SceneView], least_probability: float) -> Sightings:
    """Voxels of a map that some views of a scene see."""
    return sightings(m, views, scene.camera, scene.noise, scene.max_depth, least_probability)


def view_of(depth_m: NDArray[np.float32], T_world_camera: Pose) -> SceneView:
    return SceneView("view", T_world_camera, depth_m, depth_m, depth_m > 0)


def scene_of(views: list[SceneView], camera: PinholeCamera = CAMERA) -> Scene:
    return Scene("made", camera, PolynomialNoise(SIGMA), VolumeConfig(), MAX_DEPTH, views)


def segments(view: SceneView, centres: NDArray) -> tuple[NDArray, NDArray]:
    """Axial depths at which each ray enters and leaves each voxel, (rays, voxels); entry > exit: missed."""
    T = view.T_world_camera
    directions = CAMERA.rays().reshape(-1, 1, 3) @ T[:3, :3].T
    low, high = ((centres[None] + side * SIZE / 2 - T[:3, 3]) / directions for side in (-1, 1))
    return np.maximum(np.minimum(low, high).max(axis=-1), 0), np.maximum(low, high).min(axis=-1)


@pytest.mark.usefixtures("one_backend")
@settings(max_examples=40)
@example(seed=0, voxels=0)
@given(seed=st.integers(0, 2**32 - 1), voxels=st.integers(1, 60))
def test_what_rays_say_of_voxels_is_what_brute_force_says(seed: int, voxels: int) -> None:
    random = np.random.default_rng(seed)
    cells = np.unique(random.integers(-4, 12, (voxels, 3)), axis=0)
    m = FixedMap((cells + 0.5) * SIZE, random.uniform(0.3, 1, len(cells)).astype(np.float32))
    views = []
    for _ in range(2):
        depth = random.uniform(0.5, 9, CAMERA.shape).astype(np.float32)
        depth[random.random(CAMERA.shape) < 0.2] = 0
        views.append(view_of(depth, look_at(random.uniform(-1, 1, 3), random.uniform(2, 4, 3))))
    found = seen_by(m, scene_of(views), views, 0.4)

    kept = m.probability >= 0.4
    np.testing.assert_array_equal(found.centres, m.centres[kept])
    passed, confirmed, unsure = (np.zeros(kept.sum(), int) for _ in range(3))
    met: list[float] = []
    met_unsure: list[bool] = []
    for view in views:
        near, far = segments(view, m.centres[kept])
        slant = CAMERA.range_per_depth().reshape(-1, 1)
        z = view.measured_m.reshape(-1, 1).astype(float)
        reach = SIGMAS * (SIGMA[0] + SIGMA[2] * z**2)
        crossed = (far > near) & (z > 0)
        passes, confirms = far < z - reach, near < z + reach
        # Where rounding decides: a corner that is hardly touched, an end that lies in a voxel's face.
        edges = [far - near, far - (z - reach), near - (z + reach)]
        edges += [far - (z - reach - SIZE / slant), near - (z + reach + SIZE / slant)]
        close = np.minimum.reduce([np.abs(e) for e in edges]) < 2e-4
        passed += (crossed & passes).sum(axis=0)
        confirmed += (crossed & ~passes & confirms).sum(axis=0)
        unsure += close.sum(axis=0)
        covers = crossed & (far >= z - reach - SIZE / slant) & (near <= z + reach + SIZE / slant)
        best = np.where(covers, m.probability[kept], np.float32(-1)).max(axis=1, initial=-1)
        counts = ((z > 0) & (z <= MAX_DEPTH))[:, 0]
        met += best[counts].tolist()
        met_unsure += close.any(axis=1)[counts].tolist()
    sure = unsure == 0
    np.testing.assert_array_equal(found.passed[sure], passed[sure])
    np.testing.assert_array_equal(found.confirmed[sure], confirmed[sure])
    assert np.abs(found.passed - passed).max(initial=0) <= unsure.max(initial=0)
    certain = ~np.asarray(met_unsure, bool)
    np.testing.assert_array_equal(found.met[certain], np.asarray(met, np.float32)[certain])


def test_a_clear_majority_of_enough_rays_makes_an_artefact() -> None:
    passed = np.array([LEAST_RAYS, LEAST_RAYS - 1, 74, 75, 0])
    seen = Sightings(
        np.zeros((5, 3)),
        np.array([0.9, 0.9, 0.8, 0.7, 0.6], np.float32),
        passed,
        np.array([0, 0, 26, 25, 100]),
        np.array([0.9, 0.8, 0.65, -1], np.float32),
    )
    assert seen.judged.tolist() == [True, False, True, True, True]
    assert seen.artefacts().tolist() == [True, False, False, True, False]
    assert seen.artefacts(0.5).tolist() == [True, False, True, True, False]
    assert [seen.coverage(p) for p in (0.5, 0.7, 0.95)] == [0.75, 0.5, 0.0]
    swept = curve(seen, 0.5)
    assert (swept["occupied"][0], swept["judged"][0]) == (5, 4)
    assert [swept["artefacts"][m][0] for m in ("0.5", "0.75", "0.9")] == [3, 2, 1]
    assert np.all(np.diff(swept["coverage"]) <= 0)
    assert swept["coverage"][-1] == 0
    assert artefacts_at(swept, 0.75) == 2
    at = threshold_for(swept, 0.5)
    assert swept["coverage"][at] == 0.5 > swept["coverage"][at + 1]
    assert threshold_for(swept, 0.99) == 0


def test_artefacts_between_two_thresholds() -> None:
    swept = {"coverage": [0.9, 0.5, 0.2, 0.0], "artefacts": {"0.75": [100, 20, 4, 0]}}
    assert artefacts_at(swept, 0.7) == pytest.approx(60)
    assert artefacts_at(swept, 0.2) == 4
    assert artefacts_at(swept, 0.91) is None
    assert artefacts_at(swept, 0.19) is None  # only an empty map has less
    nothing = {"coverage": [0.0], "artefacts": {"0.75": [0]}}
    assert artefacts_at(nothing, 0.5) is None
    worse = {"coverage": [0.95, 0.7, 0.1], "artefacts": {"0.75": [500, 120, 0]}}
    assert ratio(worse, swept, 0.7, 0.75) == pytest.approx(2)
    assert ratio(nothing, swept, 0.7, 0.75) is None
    assert ratio(swept, nothing, 0.7, 0.75) is None


@pytest.mark.usefixtures("one_backend")
def test_a_lie_is_an_artefact_and_the_wall_is_none() -> None:
    """A wall 5 m ahead; the first view measured a box at 3 m that is not there."""
    camera = CAMERA.scaled(6)
    true = np.full(camera.shape, 5.2, np.float32)
    lie = true.copy()
    lie[8:20, 10:30] = 3.2
    poses = [look_at([0.05 * i, 0.1, 0.0], [0.05 * i, 0.1, 5.0], up=[0, -1, 0]) for i in range(8)]
    views = [view_of(lie if i == 0 else true, T) for i, T in enumerate(poses)]
    scene = scene_of(views, camera)
    m = Row(octomap_style()).build(scene, SIZE)
    assert len(m.keyframes) == 4
    seen = seen_by(m, scene, views[1::2], 0.0)
    depth = seen.centres[:, 2]
    floating = np.abs(depth - 3.25) < 0.1
    wall = np.abs(depth - 5.25) < 0.1
    enough = seen.passed + seen.confirmed >= LEAST_RAYS
    assert (enough & floating).any()
    assert (enough & wall).any()
    np.testing.assert_array_equal(seen.artefacts(), enough & (depth < 4.5))
    assert seen.coverage(0.5) == 1.0


@pytest.mark.usefixtures("one_backend")
def test_the_map_grows_as_the_papers_fig_5a() -> None:
    scene = corridor_scene(PolynomialNoise((0.0, 0.0, 7.5e-4)))
    grown = grow(visibility(), scene, 0.2, 70, 2)
    farthest = np.asarray(grown["farthest_m"])
    assert np.all(np.diff(farthest) >= 0)
    assert updates_to(grown, 10.0) == pytest.approx(65, abs=4)
    # A straight line from where the floor and the walls first come into view.
    x, y = np.asarray(grown["updates"])[farthest > 3], farthest[farthest > 3]
    line = np.polyfit(x, y, 1)
    assert np.abs(np.polyval(line, x) - y).max() < 0.4
    coarse = grow(visibility(), scene, 0.4, 40, 2)
    assert updates_to(coarse, 10.0) == pytest.approx(0.5 * 65, abs=4)
    assert updates_to(coarse, 100.0) is None
    at_once = grow(octomap_style(), scene, 0.4, 1, 1)
    assert at_once["updates"] == [1]
    assert at_once["farthest_m"][0] > 24
    eager = grow(visibility_at_once(), scene, 0.4, 1, 1)
    assert eager["farthest_m"][0] == pytest.approx(at_once["farthest_m"][0], abs=1.5)


FOCAL, BASELINE, SHAPE = 100.0, 0.25, (60, 160)
PAIRS = 4


def write_street(data: Path, pairs: int = PAIRS) -> Path:
    """Pairs in KITTI's layout: a wall straight ahead, a box on its left that only the first pair shows."""
    folder = data / RECORDING
    for i in range(pairs):
        wall = FOCAL * BASELINE / (4.0 - 0.1 * i)
        layers = [Layer((wall, 0.0, 0.0))]
        if i == 0:
            layers.append(Layer((2 * wall, 0.0, 0.0), box=(40, 75, 20, 50)))
        pair = render(layers, SHAPE, seed=i)
        write_image(folder / f"image_l/{i:06d}.png", pair.left)
        write_image(folder / f"image_r/{i:06d}.png", pair.right)
    P0 = np.array([[FOCAL, 0, 79.5, 0], [0, FOCAL, 29.5, 0], [0, 0, 1, 0]])
    P1 = P0 - np.array([[0, 0, 0, BASELINE * FOCAL], [0, 0, 0, 0], [0, 0, 0, 0]])
    (folder / "calib.txt").write_text(f"{row_of(P0)}\n{row_of(P1)}")
    write_rows(
        folder / "poses.txt", [look_at([0, 0, 0.1 * i], [0, 0, 9], up=[0, -1, 0])[:3] for i in range(pairs)]
    )
    return folder


def experiment(data: Path, out: Path, limit: int | None = None) -> Experiment:
    out.mkdir(exist_ok=True)
    return Experiment(data, out, Ledger(out / "stereo.jsonl", {}), (0.2,), (0,), limit)


def test_a_street_at_half_resolution(tmp_path: Path) -> None:
    write_street(tmp_path)
    whole = street_scene(tmp_path, 3)
    half = thinned(whole, 2)
    assert (len(whole.views), half.camera.shape) == (3, (30, 80))
    np.testing.assert_array_equal(half.views[1].measured_m, whole.views[1].measured_m[::2, ::2])
    np.testing.assert_allclose(half.camera.rays(), whole.camera.rays()[::2, ::2])
    sigma, _ = half.noise.table(half.camera).at_pixels(np.full((30, 80), 4.0, np.float32))
    np.testing.assert_allclose(sigma, 0.286 / (FOCAL * BASELINE) * 16, rtol=1e-5)


@pytest.mark.usefixtures("one_backend")
def test_the_whole_experiment_runs_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stereo, "GROWTH_UPDATES", {0.4: 12})
    monkeypatch.setattr(stereo, "GROWTH_ON_STREET", (0.4,))
    monkeypatch.setattr(stereo, "SCALING_SIZES", (0.2, 0.4))
    write_street(tmp_path / "data")
    first = experiment(tmp_path / "data", tmp_path / "out")
    tables, paths = stereo.run_stereo(first)
    assert first.ledger.computed > 10
    assert [table.name for table in tables] == ["stereo", "stereo_majority", "stereo_fig5a", "stereo_fig5bc"]
    assert {path.name for path in paths} >= {
        "stereo.csv", "stereo.tex", "stereo.png", "stereo_artefacts.png", "stereo_plan.png",
        "stereo_fig5a_curves.png", "stereo_fig5bc_curves.png",
    }  # fmt: skip
    assert all(path.stat().st_size > 0 for path in paths)

    rows = {row[0]: dict(zip(tables[0].columns, row, strict=True)) for row in tables[0].rows}
    octomap, at_once = rows["OctoMap-style, Table I"], rows["visibility map, at once"]
    for each in (octomap, at_once):
        assert each["coverage"] > 0.9
        assert each["artefacts"] > 0  # the box
    assert rows["MRFMap"]["artefacts"] < octomap["artefacts"]
    stated = rows["MRFMap, sigma of each pixel"]
    assert np.isfinite(stated["log-likelihood"])
    assert stated["log-likelihood"] != rows["MRFMap"]["log-likelihood"]

    again = experiment(tmp_path / "data", tmp_path / "out")
    repeated, _ = stereo.run_stereo(again)
    assert again.ledger.computed == 0
    assert repeated == tables


def test_bad_input_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="KITTI_sequence_1"):
        street_scene(tmp_path)
    write_street(tmp_path)
    with pytest.raises(ConfigError, match="KITTI_sequence_1: 1 pairs; the experiment needs at least 2"):
        street_scene(tmp_path, 1)


@pytest.fixture(scope="module")
def street(shared_data: Path) -> Scene:
    return thinned(street_scene(shared_data, 5), 4)


@pytest.mark.shared_data
@pytest.mark.usefixtures("one_backend")
def test_on_the_real_street_mrf_leaves_the_fewest_artefacts(street: Scene) -> None:
    at = {}
    for row in (Row(octomap_style()), Row(visibility_at_once()), Row(mrf_of_street(), 1, 0.03)):
        m = row.build(street, 0.4)
        swept = curve(seen_by(m, street, street.views[1::2], row.least_probability), row.least_probability)
        assert swept["coverage"][0] > 0.8
        at[row.name] = artefacts_at(swept, 0.8)
    assert at["MRFMap"] < 0.7 * at["OctoMap-style, Table I"]


@pytest.mark.shared_data
@pytest.mark.usefixtures("one_backend")
def test_on_the_real_street_a_sigma_for_each_pixel_predicts_better(street: Scene) -> None:
    """Both with the noise that maps take, and where both are judged by the disparity-only sigma."""
    plain, stated = Row(mrf_of_street()), Row(mrf_of_street(), pixel_sigma=True)
    of_plain, of_stated = (row.build(street, 0.4) for row in (plain, stated))
    assert log_likelihood(of_stated, stated, street) > log_likelihood(of_plain, plain, street) + 0.1
    assert log_likelihood(of_stated, plain, street) > log_likelihood(of_plain, plain, street)


@pytest.mark.soak
@pytest.mark.shared_data
@pytest.mark.usefixtures("one_backend")
def test_a_real_pair_grows_like_the_corridor(street: Scene) -> None:
    grown = grow(visibility(), street, 0.4, 40, 2)
    assert updates_to(grown, 10.0) == pytest.approx(0.5 * 65, abs=6)
