"""Surface and colours of a dated map as of other times, and of its layers."""

from pathlib import Path

import colored_scene as scene
import numpy as np
import pytest
from ball_room import BALL, TIME, near_ball, room_that_changed
from small_room import VOXEL_SIZE

from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.methods.mrf.map import MRFMap

pytestmark = pytest.mark.usefixtures("one_backend")

BEFORE_S = 19.0
"""The stamp of the last view before the change."""

GREEN = np.array([20, 200, 40], np.uint8)


def on_ball(vertices_m: np.ndarray) -> int:
    """Vertices within a voxel of the ball's surface."""
    radius = np.linalg.norm(vertices_m - np.array(BALL.center), axis=1)
    return int((np.abs(radius - BALL.half_size[0]) < VOXEL_SIZE).sum())


def test_the_surface_is_that_of_its_time() -> None:
    m = room_that_changed(ball_comes=False)
    before, now = m.at(BEFORE_S).surface().vertices_m, m.surface().vertices_m
    assert on_ball(before) > 40
    assert on_ball(now) < 0.2 * on_ball(before)
    # The room itself is the same.
    assert abs(len(now) - len(before)) < 0.2 * len(now)
    assert m.layer("both").has_surface
    np.testing.assert_array_equal(m.layer("both").surface().vertices_m, now)
    np.testing.assert_array_equal(m.decided.surface().vertices_m, now)


def test_layers_have_surfaces_of_their_own(tmp_path: Path) -> None:
    m = room_that_changed(ball_comes=True)
    static, dynamic = m.static.surface().vertices_m, m.dynamic.surface().vertices_m
    assert len(dynamic) > 40
    assert near_ball(dynamic).mean() > 0.5
    assert len(static) > 10_000
    assert on_ball(static) < 0.3 * on_ball(dynamic)  # those are of the floor around it
    export_map(m.dynamic, tmp_path / "moved.ply", ExportOptions(mesh=True))
    assert b"std_m" in (tmp_path / "moved.ply").read_bytes()[:1000]


def repainted(frozen: int = 0) -> MRFMap:
    """The coloured scene, of three views in which the thing is red and three in which it is green."""
    m = MRFMap(scene.VOXEL, scene.NOISE, time=TIME, keep_surface=True)
    for number, place in enumerate(scene.PLACES):
        depth_m, color = scene.view(*place, seed=number)
        if number >= 3:
            color[(color == scene.RED).all(axis=2)] = GREEN
        m.add_keyframe(depth_m, scene.pose(*place), scene.CAMERA, stamp_s=number, color=color)
    m.infer()
    for id in range(frozen):
        m.freeze_keyframe(id)
    return m


def test_colours_are_those_of_their_time() -> None:
    m = repainted()
    thing = np.array([[0.025, 0.025, scene.THING_Z], [0.075, -0.025, scene.THING_Z]])
    early, late = m.at(2.5).colors(thing), m.colors(thing)
    assert (early[:, 3] > 0).all()
    assert (np.abs(early[:, :3].astype(int) - scene.RED) < 25).all()
    # A mean of red and green, of those rays that are followed.
    assert (late[:, 1] > early[:, 1] + 20).all()
    assert late[:, 1].mean() > early[:, 1].mean() + 50
    reading = m.at(2.5)
    slots = m.view.pool.in_use
    assert (reading.colors_in(slots)[..., 3] > 0).sum() < (m.colors_in(slots)[..., 3] > 0).sum()
    assert not m.at(-1.0).has_colors
    colors = m.at(2.5).surface().colors
    assert colors is not None
    assert (colors[:, 1] < 150).all()  # nothing green yet
    assert m.surface().colors is not None


def test_there_is_no_surface_before_the_first_keyframe_and_none_after_a_change() -> None:
    m = repainted()
    with pytest.raises(ConfigError, match="no surface at this time: all keyframes are later"):
        m.at(-1.0).surface()
    reading = m.at(2.5)
    m.remove_keyframe(0)
    for ask in (reading.surface, lambda: reading.colors(np.zeros((1, 3)))):
        with pytest.raises(KeyframeError, match="has changed since it was read"):
            ask()


def test_frozen_keyframes_count_from_the_newest_of_them_on() -> None:
    m = repainted(frozen=2)
    assert not m.at(0.5).has_surface
    assert not m.at(0.5).has_colors
    after, whole = m.at(2.5), repainted().at(2.5)
    assert after.has_surface
    ours, theirs = after.surface().vertices_m, whole.surface().vertices_m
    assert abs(len(ours) - len(theirs)) < 0.1 * len(theirs)
    thing = np.array([[0.025, 0.025, scene.THING_Z]])
    np.testing.assert_allclose(after.colors(thing).astype(int), whole.colors(thing).astype(int), atol=12)
