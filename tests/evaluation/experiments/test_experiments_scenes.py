"""The scenes of the experiments: reading them, their noise, what counts, and what a broken one says."""

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import small_scenes
from small_scenes import CAMERA, COFFIN_VIEWS, FAR_WALL, HOUSE_VIEWS, KITCHEN_VIEWS, noise_tables

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.evaluation.experiments.scenes import (
    COFFIN_MARGIN,
    COFFIN_SEED,
    COFFIN_VOLUME,
    Scene,
    SceneView,
    coffin_scene,
    house_scene,
    judged_scene,
    keyframes_of,
    kitchen_scene,
)
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PatchNoise, PolynomialNoise
from taichi_mrf.sensor.simulate import KINECT_1_LATERAL, simulate, simulate_model

Damage = Callable[[Path], object]


@pytest.fixture
def spare(data: Path, tmp_path: Path) -> Path:
    """A data folder to be damaged."""
    return shutil.copytree(data, tmp_path, dirs_exist_ok=True)


def points(view: SceneView) -> np.ndarray:
    """World coordinates, (H, W, 3), of what each pixel truly sees."""
    local = CAMERA.rays() * view.true_m[..., None].astype(np.float64)
    return local @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]


def test_the_coffin_is_what_its_files_say(data: Path) -> None:
    scene = coffin_scene(data)
    assert scene.camera == CAMERA
    assert [view.name for view in scene.views] == [f"view {i:02d}" for i in range(COFFIN_VIEWS)]
    with np.load(data / "coffin_world" / "clean_depth.npz") as file:
        for view, depth, pose in zip(scene.views, file["depth_m"], file["T_world_camera"], strict=True):
            np.testing.assert_array_equal(view.true_m, np.nan_to_num(depth))
            np.testing.assert_allclose(view.T_world_camera, pose, atol=1e-12)
    sigma, bias = noise_tables()
    table = scene.noise.table(CAMERA)
    assert (table.patch, table.columns) == (20, 4)
    np.testing.assert_array_equal(table.coefficients[:, 0, :3], sigma)
    np.testing.assert_array_equal(table.coefficients[:, 1, :3], bias)
    assert scene.volume == VolumeConfig(
        lower=(-2.0 - COFFIN_MARGIN, -2.0 - COFFIN_MARGIN, -COFFIN_MARGIN),
        upper=(2.0 + COFFIN_MARGIN, 2.0 + COFFIN_MARGIN, 3.0 + COFFIN_MARGIN),
    )


def test_what_counts_is_what_lies_in_the_volume(data: Path) -> None:
    beyond = 0
    for view in coffin_scene(data).views:
        where = points(view)
        lower, upper = np.array(COFFIN_VOLUME)
        inside = ((where > lower - 0.005) & (where < upper + 0.005)).all(axis=-1)
        outside = ((where < lower - 0.015) | (where > upper + 0.015)).any(axis=-1)
        seen = view.true_m > 0
        assert view.judged[seen & inside].all()
        assert not view.judged[outside].any()
        assert not view.judged[~seen].any()
        assert not seen[small_scenes.EMPTY].any()
        on_far_wall = np.abs(where[..., 0] - FAR_WALL) < 0.01
        assert not view.judged[on_far_wall].any()
        beyond += int(on_far_wall.sum())
        assert view.judged.sum() > 0.5 * view.judged.size
    assert beyond > 100


def test_coffin_noise_is_that_of_the_learnt_tables(data: Path) -> None:
    scene = coffin_scene(data, 2)
    sigma, bias = noise_tables()
    noise = PatchNoise(sigma, bias, small_scenes.PATCH, CAMERA)
    deviations = []
    for index, view in enumerate(scene.views):
        again = simulate_model(view.true_m, CAMERA, noise, seed=COFFIN_SEED + 2000 + index)
        np.testing.assert_array_equal(view.measured_m, again)
        spread, offset = noise.table(CAMERA).at_pixels(view.true_m)
        seen = view.measured_m > 0
        deviations.append(((view.measured_m - view.true_m - offset) / spread)[seen])
    z = np.concatenate(deviations)
    assert abs(z.mean()) < 4 / math.sqrt(len(z))
    assert abs(z.std() - 1) < 4 / math.sqrt(2 * len(z))


@pytest.mark.parametrize("load", [coffin_scene, house_scene])
def test_a_seed_is_a_draw_of_the_noise(data: Path, load: Callable[[Path, int], Scene]) -> None:
    draws = [[view.measured_m for view in load(data, seed).views] for seed in (0, 0, 1)]
    for first, again, other in zip(*draws, strict=True):
        np.testing.assert_array_equal(first, again)
        both = (first > 0) & (other > 0)
        assert (first[both] != other[both]).mean() > 0.5
    true = [[view.true_m for view in load(data, seed).views] for seed in (0, 1)]
    np.testing.assert_array_equal(*true)


def test_views_of_one_draw_do_not_share_their_noise(data: Path) -> None:
    scene = coffin_scene(data)
    table = scene.noise.table(CAMERA)
    normals = []
    for view in scene.views[:2]:
        spread, offset = table.at_pixels(view.true_m)
        normals.append((view.measured_m - view.true_m - offset) / spread)
    seen = (scene.views[0].measured_m > 0) & (scene.views[1].measured_m > 0)
    assert abs(np.corrcoef(normals[0][seen], normals[1][seen])[0, 1]) < 0.1


def test_the_house_is_clean_depth_with_the_noise_of_a_kinect(data: Path) -> None:
    scene = house_scene(data, 3)
    assert len(scene.views) == HOUSE_VIEWS
    assert scene.camera == CAMERA
    truth = small_scenes.clean_depth([view.T_world_camera for view in scene.views])
    for index, (view, depth) in enumerate(zip(scene.views, truth, strict=True)):
        assert np.abs(view.true_m - depth).max() < 2e-4  # steps of the file's depth
        again = simulate(view.true_m, CAMERA, KINECT_1_LATERAL, seed=(3, index))
        np.testing.assert_array_equal(view.measured_m, again)
        np.testing.assert_array_equal(view.judged, view.true_m > 0)
    assert isinstance(scene.noise, PolynomialNoise)
    np.testing.assert_array_equal(scene.noise.sigma[0, :3], KINECT_1_LATERAL.sigma)
    assert [view.name for view in house_scene(data, 3, 2).views] == [view.name for view in scene.views[:2]]


def test_the_kitchen_is_what_was_measured(data: Path) -> None:
    scene = kitchen_scene(data)
    assert len(scene.views) == KITCHEN_VIEWS
    for index, view in enumerate(scene.views):
        png = data / "seven_scenes_redkitchen" / f"frame-{index:06d}.depth.png"
        recorded = cv2.imread(str(png), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
        np.testing.assert_allclose(view.measured_m, recorded, atol=1e-6)
        np.testing.assert_array_equal(view.true_m, view.measured_m)
        np.testing.assert_array_equal(view.judged, recorded > 0)
        assert 0.3 < view.judged.mean() < 1  # a sensor that loses something
    assert len(kitchen_scene(data, 3).views) == 3


def seen_from(angles: list[float], radius: float) -> Scene:
    """Views without pixels that matter, from places on a circle, looking at its middle."""
    nothing = np.zeros((1, 1), np.float32)
    views = [
        SceneView(
            str(a),
            look_at(np.array([radius * math.cos(a), radius * math.sin(a), 0.0]), np.zeros(3)),
            nothing, nothing, nothing > 0,
        )
        for a in angles
    ]  # fmt: skip
    return Scene(
        "circle", PinholeCamera(1, 1, 1, 1, 0, 0), PolynomialNoise((0.01,)), VolumeConfig(), 1, views
    )


@pytest.mark.parametrize(
    ("angles", "radius", "expected"),
    [
        ([0.0, 0.4, 0.6, 1.0, 1.2], 0.1, [0, 2, 4]),  # by more than half a radian since the last keyframe
        ([0.0, 0.02, 0.06], 10.0, [0, 2]),  # by more than half a metre
        ([0.0, 0.0, 0.0], 1.0, [0]),
        ([0.0, 0.6, 0.0], 1.0, [0, 1, 2]),  # back again: since the last, not since any
        ([], 1.0, []),
    ],
)
def test_keyframes_are_views_from_somewhere_new(
    angles: list[float], radius: float, expected: list[int]
) -> None:
    assert keyframes_of(seen_from(angles, radius), 0.5, 0.5) == expected


def remove(name: str) -> Damage:
    return lambda data: (data / name).unlink()


def garble(name: str, content: bytes = b"no such thing") -> Damage:
    return lambda data: (data / name).write_bytes(content)


def truncate(name: str) -> Damage:
    return lambda data: (data / name).write_bytes((data / name).read_bytes()[:2000])


def store(name: str, values: np.ndarray) -> Damage:
    return lambda data: np.save(data / name, values)


def clean(**changes: object) -> Damage:
    """Coffin views of which some arrays are others, or (None) missing."""

    def damage(data: Path) -> None:
        path = data / "coffin_world" / "clean_depth.npz"
        with np.load(path) as file:
            arrays = {**file} | changes
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})

    return damage


CLEAN, SIGMA, BIAS = (
    f"coffin_world/{name}"
    for name in ("clean_depth.npz", "realsense_stddev_poly5x.npy", "realsense_bias_poly5x.npy")
)
POSES = np.stack(small_scenes.poses(COFFIN_VIEWS, 1.0))


@pytest.mark.parametrize(
    ("damage", "name", "words"),
    [
        (remove(CLEAN), CLEAN, "No such file"),
        (remove(SIGMA), SIGMA, "No such file"),
        (remove(BIAS), BIAS, "No such file"),
        (garble(CLEAN), CLEAN, ""),
        (garble(CLEAN, b""), CLEAN, ""),
        (truncate(CLEAN), CLEAN, ""),
        (garble(SIGMA), SIGMA, ""),
        (garble(BIAS, b""), BIAS, ""),
        (clean(K=None), CLEAN, "K"),
        (clean(depth_m=None), CLEAN, "depth_m"),
        (clean(K=np.eye(2)), CLEAN, "K (2, 2)"),
        (clean(K=np.diag([-60.0, 60.0, 1.0])), CLEAN, "focal lengths"),
        (clean(depth_m=np.ones((60, 80), np.float32)), CLEAN, "depth_m (60, 80)"),
        (clean(T_world_camera=POSES[:2]), CLEAN, "T_world_camera (2, 4, 4)"),
        (clean(T_world_camera=2 * POSES), CLEAN, "pose"),
        (clean(T_world_camera=np.full((COFFIN_VIEWS, 4, 4), np.nan)), CLEAN, "not finite"),
        (store(SIGMA, np.ones((13, 3))), SIGMA, "no square patch divides 80 x 60 pixels into 13"),
        (store(SIGMA, np.ones(())), SIGMA, "no square patch"),
        (store(BIAS, np.ones((11, 3))), "coffin_world", "bias table has 11 patches"),
        (store(SIGMA, np.ones((12, 9))), "coffin_world", "sigma has degree 8"),
        (store(SIGMA, np.full((12, 3), np.nan)), "coffin_world", "sigma holds a value that is not finite"),
    ],
)
def test_a_broken_coffin_is_named_in_one_line(spare: Path, damage: Damage, name: str, words: str) -> None:
    damage(spare)
    with pytest.raises(DatasetError) as caught:
        coffin_scene(spare)
    text = str(caught.value)
    assert text.startswith(str(spare / name))
    assert words in text
    assert "\n" not in text


HOUSE, KITCHEN = "house_livingroom", "seven_scenes_redkitchen"


@pytest.mark.parametrize(
    ("load", "damage", "words"),
    [
        (house_scene, remove(f"{HOUSE}/T_world_camera.txt"), [HOUSE, "without a trajectory"]),
        (house_scene, garble(f"{HOUSE}/0001.png"), ["frame 0001", "0001.png"]),
        (house_scene, remove(f"{HOUSE}/camera.txt"), [HOUSE, "80 x 60", "640 x 480"]),
        (kitchen_scene, remove(f"{KITCHEN}/frame-000001.pose.txt"), ["frame-000001.pose.txt"]),
        (kitchen_scene, remove(f"{KITCHEN}/camera.txt"), [KITCHEN, "80 x 60", "640 x 480"]),
    ],
)
def test_a_broken_recording_is_named_in_one_line(
    spare: Path, load: Callable[[Path], Scene], damage: Damage, words: list[str]
) -> None:
    damage(spare)
    with pytest.raises(FrameError if "frame" in words[0] else DatasetError) as caught:
        load(spare)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("load", [coffin_scene, house_scene, kitchen_scene])
def test_a_missing_scene_is_named(tmp_path: Path, load: Callable[[Path], Scene]) -> None:
    with pytest.raises(DatasetError, match=str(tmp_path)) as caught:
        load(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.shared_data
def test_the_real_coffin(shared_data: Path) -> None:
    scene = coffin_scene(shared_data)
    assert len(scene.views) == 12
    assert scene.camera.shape == (480, 640)
    assert scene.noise.table(scene.camera).patch == 20
    for view in scene.views:
        where = scene.camera.rays() * view.true_m[..., None] @ view.T_world_camera[:3, :3].T
        where = (where + view.T_world_camera[:3, 3])[view.judged]
        assert (where.min(axis=0) >= np.array(COFFIN_VOLUME[0]) - 0.02).all()
        assert (where.max(axis=0) <= np.array(COFFIN_VOLUME[1]) + 0.02).all()


def test_another_sensor_judges_the_views_that_are_not_mapped(data: Path, tmp_path: Path) -> None:
    judge = tmp_path / "near.yaml"
    judge.write_text("sensor: {sigma: [0.5], bias: [0.1], min_depth: 1.0, max_depth: 3.0}\n")
    scene, clean = judged_scene(data, str(judge), 2), house_scene(data)
    assert scene.name == "house_livingroom by realsense_d435, judged by near"
    errors = {True: [], False: []}
    for index, (view, true) in enumerate(zip(scene.views, clean.views, strict=True)):
        in_range = (true.true_m >= 1) & (true.true_m <= 3) if index % 2 else true.true_m >= 0.2
        assert not view.judged[~in_range].any()
        np.testing.assert_array_equal(view.judged, view.measured_m > 0)
        np.testing.assert_array_equal(view.true_m, view.measured_m)
        errors[bool(index % 2)].append((view.measured_m - true.true_m)[view.judged])
        table = view.noise.table(CAMERA) if view.noise else None
        assert table is not None
        sigma, _ = table.at_pixels(np.full(CAMERA.shape, 2.0))
        np.testing.assert_allclose(sigma, 0.5 if index % 2 else 0.0037736 * 4, rtol=1e-5)
    assert np.std(np.concatenate(errors[True])) == pytest.approx(0.5, rel=0.1)
    assert np.mean(np.concatenate(errors[True])) == pytest.approx(0.1, abs=0.03)
    assert np.std(np.concatenate(errors[False])) < 0.05
