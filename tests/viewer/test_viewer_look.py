"""Colours, widgets made from options, clicks and curves: what the page computes by itself."""

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
import viser.transforms as vtf

from taichi_mrf.geometry.poses import as_pose, look_at
from taichi_mrf.geometry.up import up_of, up_vector
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.viewer.messages import LOG_ODDS_STEP, KeyframeInfo, RayAnswer, pack_log_odds
from taichi_mrf.viewer.scene.coloring import COLORINGS, Scale, legend_html, shaded
from taichi_mrf.viewer.scene.keyframe_layer import (
    FRUSTUM_M,
    RING_M,
    border,
    first_pixel,
    first_voxel,
    placement,
)
from taichi_mrf.viewer.scene.ray_plot import curves
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.voxel_layer import look_of
from taichi_mrf.viewer.scene.voxel_store import Shown, VoxelStore, facing
from taichi_mrf.voxels.colors import NO_COLOR

HEIGHTS = (0.0, 2.0)
UP = np.array([0.0, 0.0, 1.0])


def shown(log_odds: np.ndarray, seen: np.ndarray | None = None) -> Shown:
    n = len(log_odds)
    return Shown(
        np.zeros((n, 3), np.uint8),
        pack_log_odds(log_odds.astype(np.float32)),
        np.zeros(n, np.uint8) if seen is None else seen.astype(np.uint8),
    )


def scale_of(name: str, *some: Shown, heights_m: tuple[float, float] = HEIGHTS) -> Scale:
    """The scale of a colouring for a map that has these voxels, all at height 0."""
    measure = COLORINGS[name].voxels
    numbers = [measure.of(each, np.zeros((len(each.cells), 3)), UP) for each in some]
    return measure.scale(np.concatenate(numbers or [np.zeros(0)]), heights_m)


LIKELY, UNLIKELY = shown(np.array([0.0, 5.0])), shown(np.array([-1.0, 5.0]))


def test_chances_have_their_colours_and_those_between_are_blended() -> None:
    chances = {0.5: (240, 110, 40), 0.9: (247, 190, 95), 0.99: (150, 200, 180), 0.999: (60, 140, 190)}
    p = np.array(list(chances))
    scale = scale_of("marginal probability", LIKELY)
    colors = scale.paint(shown(np.log(p / (1 - p))), np.zeros((4, 3)), UP).astype(int)
    # 256 colours, and the log-odds are rounded to 1/512.
    assert np.abs(colors - list(chances.values())).max() <= 2
    between = scale.paint(shown(np.array([1.0986])), np.zeros((1, 3)), UP).astype(int)  # 3 in 4
    assert np.abs(between - (colors[0] + colors[1]) / 2).max() <= 2
    unlikely = scale_of("marginal probability", UNLIKELY)
    assert np.abs(unlikely.paint(shown(np.zeros(1)), np.zeros((1, 3)), UP).astype(int) - colors[0]).max() <= 2


def test_the_legend_of_chances_reads_in_chances() -> None:
    likely, every = (legend_html(scale_of("marginal probability", some)) for some in (LIKELY, UNLIKELY))
    assert re.findall("<span>(.*?)</span>", likely) == ["1 in 2", "9 in 10", "99 in 100", "999 in 1000"]
    assert re.findall("<span>(.*?)</span>", every) == ["1 in 1000", "1 in 2", "999 in 1000"]
    assert "chance that a voxel is occupied" in likely


def test_the_scale_reaches_down_when_improbable_voxels_are_shown() -> None:
    assert scale_of("marginal probability", LIKELY).low == 0.0
    low = scale_of("marginal probability", UNLIKELY)
    dark = low.paint(shown(np.array([-20.0])), np.zeros((1, 3)), UP)
    np.testing.assert_array_equal(dark[0], low.colors[0])


def test_uncertainty_is_brightest_at_one_half_and_its_ends_are_where_the_values_lie() -> None:
    log_odds = np.array([0.0, 1.0, -1.0, 7.0])
    scale = scale_of("uncertainty", shown(log_odds))
    p = 1 / (1 + np.exp(-log_odds))
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))  # 1, 0.84, 0.84 and 0.0105 bits
    assert (scale.low, scale.high) == (0.06, 1.0)  # two in a hundred lie below: 0.0603 bits
    colors = scale.paint(shown(log_odds), np.zeros((4, 3)), UP)
    share = np.log(np.maximum(entropy, scale.low) / scale.low) / np.log(scale.high / scale.low)
    expected = scale.colors[np.rint(255 * share).astype(int)].astype(int)
    assert np.abs(colors - expected).max() <= 2
    np.testing.assert_array_equal(colors[0], scale.colors[255])
    np.testing.assert_array_equal(colors[3], scale.colors[0])
    assert scale.colors[0].max() > 60  # no black


def test_keyframes_are_counted_on_a_logarithmic_scale_up_to_the_most_that_there_are() -> None:
    seen = np.array([0, 1, 9, 81, 90])
    scale = scale_of("keyframes that see it", shown(np.zeros(5), seen))
    assert (scale.low, scale.high) == (1.0, 90.0)
    colors = scale.paint(shown(np.zeros(5), seen), np.zeros((5, 3)), UP)
    steps = [0, 0, *(round(255 * math.log(many) / math.log(90)) for many in (9, 81)), 255]
    np.testing.assert_array_equal(colors, scale.colors[steps])
    assert scale_of("keyframes that see it").high == 2.0


def test_heights_run_over_the_map() -> None:
    scale = scale_of("height", heights_m=(1.0, 3.0))
    colors = scale.paint(shown(np.zeros(3)), np.array([[9.0, 0, 1], [8, 0, 2], [7, 5, 3]]), UP)
    np.testing.assert_array_equal(colors, scale.colors[[0, 128, 255]])
    assert re.findall("<span>(.*?)</span>", legend_html(scale))[::2] == ["0", "2"]


def test_stray_voxels_do_not_stretch_the_range_of_heights() -> None:
    store = VoxelStore()
    flat = np.array([[x, y, 0] for x in range(8) for y in range(8)], np.int32)
    store.put(flat, log_odds=np.full((64, 512), 900, np.int16))
    speck = np.full((1, 512), -900, np.int16)
    speck[0, 0] = 900
    store.put(np.array([[0, 0, 7]], np.int32), log_odds=speck)
    scale = look_of(ViewOptions(), store, (2, 1), 0.1).scale
    assert (scale.low, scale.high) == pytest.approx((0.0, 0.8))
    turned = VoxelStore()
    for brick in flat[::-1]:
        turned.put(brick[None], log_odds=np.full((1, 512), 900, np.int16))
    turned.put(np.array([[0, 0, 7]], np.int32), log_odds=speck)
    np.testing.assert_array_equal(turned.sample(0.0)[1], store.sample(0.0)[1])  # whatever order they came in


def test_a_photo_shows_what_cameras_saw_and_grey_where_none_did() -> None:
    scale, store = scale_of("photo"), VoxelStore()
    bricks = np.array([[0, 0, 0], [0, 0, 1], [9, 0, 0]], np.int32)
    colors = np.random.default_rng(0).integers(0, 255, (3, 512, 3)).astype(np.uint8)
    store.put(bricks[:2], colors=colors[:2])  # may come before the voxels, which are hidden until then
    assert not len(store.shown((0, 0, 0), 0.0, None).cells)
    assert store.put(bricks, log_odds=np.full((3, 512), 100, np.int16), seen=np.ones((3, 512), np.uint8))
    seen = store.shown((0, 0, 0), 0.0, None)
    np.testing.assert_array_equal(scale.paint(seen, np.zeros((1024, 3)), UP), colors[:2].reshape(-1, 3))
    unseen = store.shown((1, 0, 0), 0.0, None)
    np.testing.assert_array_equal(scale.paint(unseen, np.zeros((512, 3)), UP), np.full((512, 3), NO_COLOR))
    assert "grey where none did" in legend_html(scale)
    store.remove(bricks[:1])
    left = store.shown((0, 0, 0), 0.0, None)
    np.testing.assert_array_equal(scale.paint(left, np.zeros((512, 3)), UP), colors[1])


@pytest.mark.parametrize("name", COLORINGS)
def test_every_colouring_has_a_help_and_one_with_a_scale_a_legend_with_its_ends(name: str) -> None:
    assert COLORINGS[name].help.endswith(".")
    scale = scale_of(name, shown(np.array([0.0, 2.0, 5.0]), np.array([1, 2, 3])))
    marks = re.findall("<span>(.*?)</span>", legend_html(scale))
    assert bool(marks) == bool(len(scale.colors))
    if name in ("uncertainty", "keyframes that see it"):
        assert marks == [f"{scale.low:.3g}", f"{scale.measure.label}, log scale", f"{scale.high:.3g}"]


def test_up_is_the_axis_that_cameras_hold_upwards() -> None:
    # OpenCV's camera looks along z with y down; here it looks along the world's x, level.
    level = np.eye(4)
    level[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert up_of(as_pose(level)) == (2, 1)
    np.testing.assert_array_equal(up_vector(up_of(np.eye(4))), [0, -1, 0])


def test_looks_that_differ_only_in_unused_heights_are_the_same() -> None:
    small, large = VoxelStore(), VoxelStore()
    large.put(np.array([[5, 5, 5]], np.int32), log_odds=np.zeros((1, 512), np.int16))
    by_marginal, by_height = ViewOptions(color_by="marginal probability"), ViewOptions()
    assert not len(small.sample(0.0)[0].cells)
    up = (2, 1)
    assert look_of(by_marginal, small, up, 0.05) == look_of(by_marginal, large, up, 0.05)
    assert look_of(by_height, small, up, 0.05) != look_of(by_height, large, up, 0.05)


@pytest.mark.parametrize(
    "changes",
    [
        {"threshold": 0.6},
        {"cut_axis": "x"},
        {"size": 0.5},
        {"shade": False},
        {"color_by": "uncertainty"},
        {"changes": False},
    ],
    ids=str,
)
def test_every_option_of_the_voxels_makes_another_look(changes: dict[str, Any]) -> None:
    store = VoxelStore()
    store.put(np.array([[5, 5, 5]], np.int32), log_odds=np.zeros((1, 512), np.int16))
    options = ViewOptions()
    before = look_of(options, store, (2, 1), 0.05)
    assert look_of(dataclasses.replace(options, **changes), store, (2, 1), 0.05) != before
    assert look_of(options, store, (2, -1), 0.05) != before


CAMERA = PinholeCamera(64, 48, 50.0, 55.0, 30.0, 25.0)


def keyframe(id: int, T_world_camera: np.ndarray, camera: Camera = CAMERA) -> KeyframeInfo:
    picture, crossed = np.zeros((2, 2, 3), np.uint8), np.zeros((0, 3), np.int32)
    return KeyframeInfo(id, "k", T_world_camera, camera, 1, "on", picture, crossed, T_world_camera)


def test_a_click_on_a_picture_finds_its_pixel() -> None:
    rng = np.random.default_rng(3)
    wxyz_xyz = rng.normal(size=7)
    wxyz_xyz[:4] /= np.linalg.norm(wxyz_xyz[:4])
    T = vtf.SE3(wxyz_xyz).as_matrix()
    u, v = 12.0, 40.0
    on_picture = FRUSTUM_M * np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
    point = T[:3, :3] @ on_picture + T[:3, 3]
    eye = point + rng.normal(size=3)
    hit = first_pixel(eye, point - eye, [keyframe(7, T)])
    assert hit is not None
    assert (hit.keyframe, round(hit.u, 6), round(hit.v, 6)) == (7, u, v)
    assert hit.range_m == pytest.approx(np.linalg.norm(point - eye))
    assert first_pixel(eye, eye - point, [keyframe(7, T)]) is None
    np.testing.assert_allclose(vtf.SE3(np.concatenate(placement(T))).as_matrix(), T, atol=1e-12)


LIDAR = SphericalCamera(np.linspace(0.5, -0.5, 12), np.linspace(3.0, -3.0, 60))


def test_a_click_on_a_ring_finds_the_pixel_on_its_near_side() -> None:
    T = look_at((1.0, 2.0, 0.5), (2.0, 3.0, 0.5))
    ray = LIDAR.rays()[4, 45]
    point = T[:3, :3] @ (RING_M * ray) + T[:3, 3]
    eye = point + T[:3, :3] @ (2.0 * ray + (0.1, -0.2, 0.1))
    hit = first_pixel(eye, point - eye, [keyframe(3, T, LIDAR)])
    assert hit is not None
    assert (hit.keyframe, hit.u, hit.v) == (3, 45, 4)
    np.testing.assert_allclose(hit.point, point, atol=1e-9)
    assert hit.range_m == pytest.approx(np.linalg.norm(point - eye))
    above = T[:3, 3] + T[:3, :3] @ (0.0, 0.0, 1.0)  # no ray goes straight up or down
    assert first_pixel(above, T[:3, 3] - above, [keyframe(3, T, LIDAR)]) is None
    assert first_pixel(eye, eye - point, [keyframe(3, T, LIDAR)]) is None


def test_a_click_on_what_a_moving_lidar_saw_finds_the_pixel() -> None:
    T, poses = look_at((1.0, 2.0, 0.5), (2.0, 3.0, 0.5)), np.tile(np.eye(4), (60, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.3, 0.5, 60)
    moving = RayTable.moving(LIDAR, poses)
    at = points_at(moving, np.full(moving.shape, RING_M))[4, 45]
    point = T[:3, :3] @ at + T[:3, 3]
    eye = point + T[:3, :3] @ (2.0 * LIDAR.rays()[4, 45] + (0.1, -0.2, 0.1))
    hit = first_pixel(eye, point - eye, [keyframe(3, T, moving)])
    assert hit is not None
    assert (hit.keyframe, hit.u, hit.v) == (3, 45, 4)
    assert hit.point is not None
    np.testing.assert_allclose(hit.point, point, atol=1e-6)
    seen = moving.project((T[:3, :3].T @ (hit.point - T[:3, 3]))[None])[0]
    np.testing.assert_allclose(seen, [45, 4, RING_M], atol=1e-5)
    assert first_pixel(eye, eye - point, [keyframe(3, T, moving)]) is None


@pytest.mark.parametrize(("reach", "ends"), [(np.pi, 0), (1.0, 2)])
def test_a_lidar_is_drawn_as_rings_or_as_a_closed_line(reach: float, ends: int) -> None:
    azimuths = np.linspace(reach, -reach, 60, endpoint=False)
    lines = border(SphericalCamera(np.linspace(0.5, -0.3, 12), azimuths), 0.2)
    np.testing.assert_allclose(np.linalg.norm(lines, axis=-1), 0.2, atol=1e-6)
    heights = np.arcsin(np.clip(lines[..., 2] / 0.2, -1, 1))
    assert heights.max() == pytest.approx(0.5, abs=1e-5)
    assert heights.min() == pytest.approx(-0.3, abs=1e-5)
    upright = np.abs(np.diff(heights, axis=1)) > 1e-4
    assert upright.sum() == ends * 11
    assert len(lines) == 120 if ends == 0 else 2 * 59 + 2 * 11


def test_a_click_meets_the_nearest_voxel_on_its_way() -> None:
    centres = np.array([[3.0, 0.02, 0], [2.0, 0.03, 0], [1.0, 0.2, 0], [-1.0, 0, 0]])
    hit = first_voxel((0, 0, 0), (5, 0, 0), centres, 0.1)
    assert hit is not None
    np.testing.assert_array_equal(hit[0], centres[1])
    assert hit[1] == pytest.approx(2.0)
    assert first_voxel((0, 0, 0), (0, 0, 1), centres, 0.1) is None


def answer(measured_m: float | None) -> RayAnswer:
    return RayAnswer(
        "ray",
        (0, 0, 0),
        (1, 0, 0),
        distance=np.array([0.5, 0.875, 2.0], np.float32),
        length=np.array([0.5, 0.25, 0.5], np.float32),
        occupancy=np.array([0.2, 0.4, 0.9], np.float32),
        visibility=np.array([1.0, 0.8, 0.5], np.float32),
        omega=np.array([0.1, 0.2, 4.0], np.float32),
        measured_m=measured_m,
        bias_m=0.1,
        sigma_m=0.05,
    )


def test_the_curves_are_steps_over_the_voxels() -> None:
    x, band, measured, visibility, omega, occupancy = curves(answer(1.95))
    assert np.all(np.diff(x) > 0)
    for at, p, vis, om in ((1.2, 0.0, 0.8, 0.0), (1.85, 0.9, 0.5, 1.0)):
        here = np.argmin(np.abs(x - at))
        assert occupancy[here] == pytest.approx(p)
        assert visibility[here] == pytest.approx(vis)
        assert omega[here] == pytest.approx(om)
    assert x[0] == pytest.approx(1.8 - 0.75, abs=1e-5)
    # The band is the measurement less its bias, and one sigma to either side.
    np.testing.assert_allclose([x[band > 0].min(), x[band > 0].max()], [1.8, 1.9], atol=1e-5)
    np.testing.assert_allclose(x[measured > 0], 1.95, atol=2e-6)
    assert np.ptp(x[np.flatnonzero(measured)[[0, -1]] + [-1, 1]]) < 1e-4  # a line, no triangle
    assert not curves(answer(None))[1].any()


def test_an_empty_ray_has_curves_too() -> None:
    none = np.zeros(0, np.float32)
    empty = RayAnswer("ray", (0, 0, 0), (1, 0, 0), none, none, none, none, none, None, 0.0, 0.01)
    assert all(len(curve) == len(curves(empty)[0]) for curve in curves(empty))


def test_packed_steps_are_what_the_store_compares_with() -> None:
    store = VoxelStore()
    values = np.full((1, 512), round(0.4 / LOG_ODDS_STEP), np.int16)
    store.put(np.zeros((1, 3), np.int32), log_odds=values)
    p = 1 / (1 + math.exp(-0.39))
    assert len(store.shown((0, 0, 0), math.log(p / (1 - p)), None).cells) == 512
    assert len(store.shown((0, 0, 0), 0.41, None).cells) == 0


def test_surfaces_are_darkened_by_the_way_they_face() -> None:
    grid = np.zeros((64, 64, 64), bool)
    grid[10, 5:15, 5:15] = True  # a wall across x
    grid[40, 40, 40] = True
    grid[63, 20:23, 20:23] = True  # at the chunk's end: the next chunk may go on
    cells = np.argwhere(grid).astype(np.uint8)
    numbers = facing(cells)
    for cell, number in zip(cells.tolist(), numbers.tolist(), strict=True):
        missing = [sum(not grid[tuple(c)] for c in neighbours(cell, axis)) for axis in range(3)]
        assert number == (missing[0] * 3 + missing[1]) * 3 + missing[2]
    bright = np.full((3, 3), (60, 140, 190), np.uint8)
    plain, dark = bright.astype(float), shaded(bright, np.array([18, 2, 0], np.uint8)).astype(float)
    assert np.all(dark[0] < 0.8 * plain[0] + 1)
    np.testing.assert_array_equal(dark[1], plain[1])  # level surfaces stay as bright as the scale says


def neighbours(cell: list[int], axis: int) -> list[list[int]]:
    """The two next to a cell along an axis that are in the chunk."""
    both = [[c + step * (a == axis) for a, c in enumerate(cell)] for step in (-1, 1)]
    return [each for each in both if 0 <= each[axis] < 64]
