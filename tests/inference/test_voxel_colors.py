"""Colours by posterior: against NumPy ray by ray, and what edits and hidden surfaces must not change."""

from pathlib import Path
from typing import Any

import colored_scene as scene
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from one_pixel import VOXEL, FineMap, cavities, look_along, spread
from oracles import inference as reference
from oracles.forward import Noise

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.inference.voxel_share import VoxelShare
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layers import COLORS
from taichi_mrf.voxels.layout import VOXELS

# Written out, and not imported: these tests hold the value.
WEIGHT_STEPS = 255 / 32

pytestmark = pytest.mark.usefixtures("backend")


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 3), sigma=st.floats(0.03, 0.15))
def test_colours_are_those_of_the_posterior(seed: int, count: int, sigma: float) -> None:
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(2, 2, 8.0, 8.0, 0.5, 0.5)
    config = InferenceConfig(outlier_floor=1e-3, ray_density=0.0)
    m = FineMap(VOXEL, PolynomialNoise((sigma,)), inference=config, max_depth=1.5)
    rays, images = {}, {}
    middle = rng.uniform(-1, 1, 3)
    for _ in range(count):
        direction = rng.normal(size=3)
        T = look_along(middle - 0.6 * direction / np.linalg.norm(direction), direction, rng)
        depth = rng.uniform(0.55, 0.65, camera.shape).astype(np.float32)
        color = rng.integers(1, 256, (2, 2, 3)).astype(np.uint8)
        color[0, 0] = 0  # a pixel without a colour
        id = m.add_keyframe(depth, T, camera, color=color)
        rays[id] = reference.cast(depth, T, camera, VOXEL, Noise((sigma,)), max_depth=1.5)
        images[id] = color.reshape(-1, 3).astype(float)
    assume(all(s.length > 0.01 for cast in rays.values() for ray in cast for s in ray.segments))
    m.infer()
    sums: dict[reference.Voxel, np.ndarray] = {}
    for id, k in m.keyframes.items():
        mine: dict[reference.Voxel, np.ndarray] = {}
        cavity = cavities(m, k)
        for ray, rgb in zip(rays[id], images[id], strict=True):
            if rgb.any():
                for voxel, w in spread(ray, cavity, config, m.prior).items():
                    mine[voxel] = mine.get(voxel, np.zeros(4)) + w * np.append(rgb, 1.0)
        for voxel, share in mine.items():
            weight = np.rint(share[3] * WEIGHT_STEPS)
            mean = np.append(share[:3] / max(share[3], 1e-12), 1.0)
            sums[voxel] = sums.get(voxel, np.zeros(4)) + weight * mean
    voxels = [voxel for voxel, total in sums.items() if total[3] > 0]
    assert voxels
    got = m.colors((np.array(voxels) + 0.5) * VOXEL).astype(float)
    expected = np.array([np.append(sums[v][:3] / sums[v][3], sums[v][3]) for v in voxels])
    # One step of weight may fall the other way, and then the mean of two keyframes shifts.
    sure = (np.abs(got[:, 3] - expected[:, 3]) < 0.5) | (count == 1)
    assert sure.mean() > 0.8
    np.testing.assert_allclose(got[sure, :3], expected[sure, :3], atol=2.5)
    np.testing.assert_allclose(got[:, 3], expected[:, 3], atol=count)


@settings(max_examples=8)
@given(history=scene.HISTORIES, final=scene.FINAL)
def test_any_history_ends_in_the_colours_of_the_final_set(
    history: list[tuple[str, int]], final: list[int]
) -> None:
    m = scene.edited(history, final, look=lambda m: m.colors(scene.probes()[:1]))
    expected = scene.build(sorted(final)).colors(scene.probes())
    assert (expected[:, 3] > 0).sum() > 500
    np.testing.assert_array_equal(m.colors(scene.probes()), expected)


def test_what_is_frozen_keeps_its_colours() -> None:
    m = scene.build([0, 1, 2])
    before = m.colors(scene.probes())
    for id in list(m.keyframes):
        m.freeze_keyframe(id)
        np.testing.assert_array_equal(m.colors(scene.probes()), before)


NEARER, FARTHER = [[0.02, 0.02, 1.975]], [[0.02, 0.02, 2.025]]


def add_walls(m: MRFMap, depth_m: float, color: tuple[int, int, int], count: int = 1) -> list[int]:
    """Views of a wall of one colour, about the face between bricks at 2 m."""
    camera = PinholeCamera(64, 64, 60.0, 60.0, 31.5, 31.5)
    image = np.full((*camera.shape, 3), color, np.uint8)
    return [
        m.add_keyframe(np.full(camera.shape, depth_m), np.eye(4), camera, color=image) for _ in range(count)
    ]


def with_a_brick_gone(**parameters: Any) -> MRFMap:
    """The frozen view is red and sees the nearer bricks, which only the others had, which are removed."""
    m = MRFMap(0.05, PolynomialNoise((0.002,)), **parameters)
    red, greens = add_walls(m, 2.008, (200, 0, 0)), add_walls(m, 1.99, (0, 200, 0), 3)
    m.infer()
    assert (m.colors(NEARER + FARTHER)[:, 3] > 0).all()
    m.freeze_keyframe(red[0])
    for id in greens:
        m.remove_keyframe(id)
    return m


@pytest.mark.parametrize("settled", [True, False])
def test_colours_of_bricks_that_are_gone_go_with_them(tmp_path: Path, settled: bool) -> None:
    m = with_a_brick_gone()
    if settled:
        m.infer()
        assert m.colors(NEARER)[0, 3] == 0
        np.testing.assert_array_equal(m.colors(FARTHER)[0, :3], (200, 0, 0))
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    loaded.infer()
    np.testing.assert_array_equal(loaded.colors(FARTHER)[0, :3], (200, 0, 0))


def test_colours_of_bricks_that_are_gone_do_not_come_back_with_others() -> None:
    """The evidence of the frozen view in these bricks is gone, too."""
    m = with_a_brick_gone()
    add_walls(m, 1.99, (0, 200, 0))
    m.infer()
    np.testing.assert_array_equal(m.colors(NEARER)[0, :3], (0, 200, 0))


def test_a_chunk_that_leaves_the_window_holds_no_colours_of_bricks_that_are_gone(tmp_path: Path) -> None:
    pytest.importorskip("zarr", reason="a window needs the extra store")
    m = with_a_brick_gone(volume=VolumeConfig(window_m=6.0))
    assert m.window is not None
    m.window.park_in(tmp_path / "far.zarr")
    m.window.follow(m, np.array([50.0, 0.0, 0.0]))
    assert not m.colors(FARTHER).any()
    m.window.follow(m, np.zeros(3))
    np.testing.assert_array_equal(m.colors(FARTHER)[0, :3], (200, 0, 0))


def test_recent_colours_are_not_those_of_a_brick_that_had_the_slot_before() -> None:
    m = with_a_brick_gone()
    seen = m.pixel_layers[COLORS].follow().reshape(-1, VOXELS, 4).any(axis=(1, 2))
    slot = int(np.flatnonzero(seen)[0])
    m._registry._release(np.array([slot], np.int32))  # as when it leaves a window
    other = m._registry.create(np.array([[40, 40, 40]], np.int32))
    m.view.pool.owners[other] = 1
    assert other.tolist() == [slot]
    assert not m.pixel_layers[COLORS].follow().reshape(-1, VOXELS, 4)[slot].any()


def test_nothing_smears_onto_what_stands_behind() -> None:
    """The image of the thing reaches over the wall behind it, whose voxels other views see."""
    m = scene.build([0, 1, 2, 3, 4, 5])
    points, _ = m.voxels(0.5)
    color = m.colors(points).astype(int)
    seen = color[:, 3] > 0
    assert seen.mean() > 0.95
    on_thing = np.abs(points[:, 2] - scene.THING_Z) < 2 * scene.VOXEL
    on_wall = np.abs(points[:, 2] - scene.WALL_Z) < 2 * scene.VOXEL
    assert (on_thing | on_wall).all()
    assert on_thing.sum() > 50
    behind = on_wall & (np.abs(points[:, :2]) < 1.5 * scene.HALF).all(axis=1)
    assert (behind & seen).sum() > 20  # hidden to some views and seen by others
    for rows, own in ((on_wall & seen, scene.BLUE), (on_thing & seen, scene.RED)):
        off = np.abs(color[rows, :3] - own.astype(int)).max(axis=1)
        assert np.median(off) == 0
        assert (off > 60).mean() < 0.02  # pixels on the edge of the thing


@pytest.mark.parametrize("depth_m", [0.8, 3.0])
def test_a_measurement_that_the_map_holds_for_an_outlier_has_no_say(depth_m: float) -> None:
    """A green image, wrong everywhere: in space that four views saw free, or behind what they saw."""
    m = scene.build([0, 1, 2, 3])
    green = np.full((*scene.CAMERA.shape, 3), (0, 255, 0), np.uint8)
    wrong = np.full(scene.CAMERA.shape, depth_m, np.float32)
    m.add_keyframe(wrong, scene.pose(0.0), scene.CAMERA, color=green)
    m.infer()
    points, _ = m.voxels(0.5)
    color = m.colors(points[points[:, 2] < 2.2])
    assert (color[:, 3] > 0).sum() > 300
    assert color[:, 1].max() <= scene.BLUE[1] + 5


def test_the_surface_below_voxels_has_their_colours() -> None:
    surface = scene.build([0, 1, 2, 3]).surface()
    assert surface.colors is not None
    seen = (surface.colors != NO_COLOR).any(axis=1)
    assert seen.mean() > 0.9
    near = surface.vertices_m[:, 2] < 1.6
    for rows, own in ((near & seen, scene.RED), (~near & seen, scene.BLUE)):
        assert np.median(np.abs(surface.colors[rows].astype(int) - own).max(axis=1)) <= 1


def test_files_keep_colours(tmp_path: Path) -> None:
    m = scene.build([0, 1, 2, 3])
    m.freeze_keyframe(1)
    m.infer()
    expected = m.colors(scene.probes())
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert loaded.has_colors
    np.testing.assert_array_equal(loaded.colors(scene.probes()), expected)
    for k in loaded.keyframes.values():
        np.testing.assert_array_equal(k.color, m.keyframes[k.id].color)
    loaded.infer()
    np.testing.assert_array_equal(loaded.colors(scene.probes()), expected)


def test_new_keyframes_alone_bring_recent_colours_up_to_date() -> None:
    m = scene.build([0])
    first = m.pixel_layers[COLORS].follow()
    id = scene.add(m, 3)
    m.infer(keyframes=[id])
    both = m.pixel_layers[COLORS].follow()
    assert (both[: len(first)] != first).any()
    m.remove_keyframe(id)
    m.infer()
    np.testing.assert_array_equal(
        m.pixel_layers[COLORS].follow(), m.colors_in(np.arange(m.view.pool.capacity)).reshape(-1, 4)
    )


def test_without_colour_images_there_are_none_and_wrong_ones_are_refused() -> None:
    m = MRFMap(scene.VOXEL, scene.NOISE)
    depth, color = scene.view(0.0)
    m.add_keyframe(depth, scene.pose(0.0), scene.CAMERA)
    m.infer()
    assert not m.has_colors
    assert not m.colors(scene.probes()[:10]).any()
    for wrong in (color[1:], color.astype(float), color[..., 0]):
        with pytest.raises(KeyframeError, match="the image color must be uint8 of the shape"):
            m.add_keyframe(depth, scene.pose(0.0), scene.CAMERA, color=wrong)
    with pytest.raises(ConfigError, match="log_odds has no colours"):
        LogOddsMap(scene.VOXEL).add_keyframe(depth, scene.pose(0.0), scene.CAMERA, color=color)


def test_shares_add_up_voxel_by_voxel() -> None:
    bricks = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0]], np.int32)
    numbers, ones = np.array([3, 7, 3], np.int32), np.ones(3, np.int64)
    a = VoxelShare(bricks, numbers, np.stack([ones, 2 * ones], axis=1))
    b = VoxelShare(bricks[1:], numbers[1:], np.stack([10 * ones[1:], ones[1:]], axis=1))
    both = b.plus(a)
    np.testing.assert_array_equal(both.bricks, bricks)
    np.testing.assert_array_equal(both.numbers, numbers)
    np.testing.assert_array_equal(both.sums, [[1, 2], [11, 3], [11, 3]])
    assert len(VoxelShare.nothing(2).plus(VoxelShare.nothing(2)).numbers) == 0
