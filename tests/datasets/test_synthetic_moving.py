"""The room in which something moves: where things are at a time, and that pictures and truth agree on it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.analytic_scene import Solid, distance_to
from taichi_mrf.datasets.synthetic.room import (
    PERIOD_S,
    SCRIPTS,
    Place,
    Stay,
    SyntheticRoom,
    Thing,
    distance_to_solids,
    moving_room,
    placed,
    way,
)

VARIANTS = range(4)
number = st.floats(-2, 2)
HERE, THERE = Place(1.0, 2.0), Place(3.0, 2.0, 0.5, math.pi)


def inside(solids: tuple[Solid, ...]) -> NDArray[np.float64]:
    """Points spread in some solids, at least 2 cm or half their thickness deep."""
    random = np.random.default_rng(0)
    points = []
    for solid in solids:
        half = np.maximum(np.array(solid.half_size) - 0.02, 0.5 * np.array(solid.half_size))
        if solid.kind != "box":
            half[:2] *= math.sqrt(0.5)  # the square within the circle
        if solid.kind == "sphere":
            half *= 0.8
        local = random.uniform(-1, 1, (150, 3)) * half
        c, s = math.cos(solid.yaw), math.sin(solid.yaw)
        points.append(solid.center + local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    return np.concatenate(points)


def opened(source: str) -> SyntheticRoom:
    dataset = open_dataset(source, color=False)
    assert isinstance(dataset, SyntheticRoom)
    return dataset


@given(number, number, number, st.floats(-4, 4), st.lists(st.tuples(number, number, number), min_size=1))
def test_a_placed_solid_is_the_same_solid_elsewhere(
    x: float, y: float, z: float, yaw: float, points: list[tuple[float, float, float]]
) -> None:
    solid = Solid("box", (0.3, -0.2, 0.5), (0.4, 0.2, 0.1), 0.7)
    c, s = math.cos(yaw), math.sin(yaw)
    moved = np.array(points) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (x, y, z)
    there = distance_to_solids(placed([solid], Place(x, y, z, yaw)), moved)
    np.testing.assert_allclose(there, distance_to(solid, np.array(points)), atol=1e-9)


def test_a_thing_is_where_its_stays_say() -> None:
    ball = Solid("sphere", (0, 0, 1), (0.1, 0.1, 0.1))
    thing = Thing("ball", (ball,), (Stay(2.0, 8.0, HERE, HERE), Stay(10.0, 12.0, HERE, THERE)))
    assert [bool(thing.solids_at(t)) for t in (0.0, 2.0, 7.9, 8.0, 9.9, 10.0, 12.0)] == [
        False, True, True, False, False, True, False,
    ]  # fmt: skip
    (halfway,) = thing.solids_at(11.0)
    np.testing.assert_allclose(halfway.center, (2.0, 2.0, 1.25))
    assert halfway.yaw == pytest.approx(math.pi / 2)
    assert [stay.stands for stay in thing.stays] == [True, False]
    assert not thing.walks
    (moved,) = thing.moved_by((1.0, 0.0, -1.0)).solids_at(2.0)
    np.testing.assert_allclose(moved.center, (2.0, 2.0, 0.0))


def test_a_way_takes_as_long_as_its_length() -> None:
    first, second = way(3.0, 0.5, [(0, 0), (2, 0), (2, 1)])
    assert (first.start_s, first.end_s, second.end_s) == (3.0, 7.0, 9.0)
    assert first.place(5.0) == Place(1.0, 0.0)
    assert second.begin.yaw == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_camera_keeps_clear(script: str, variant: int) -> None:
    scene = moving_room(script, variant)
    for stamp in np.arange(0, 2 * PERIOD_S, 1.0):
        eye = scene.camera.pose(stamp)[:3, 3]
        assert scene.at(stamp).signed_distance(eye)[0] > 0.4, stamp  # the least depth of a Kinect


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_things_pass_through_nothing(script: str, variant: int) -> None:
    scene = moving_room(script, variant)
    for stamp in np.arange(0, PERIOD_S, 1.7):
        for thing in scene.things:
            solids = thing.solids_at(stamp)
            if not solids:
                continue
            within = inside(solids)
            assert distance_to_solids(solids, within).max() < -0.005
            assert scene.static.signed_distance(within).min() > 0, (stamp, thing.name)
            others = [s for other in scene.things if other is not thing for s in other.solids_at(stamp)]
            assert distance_to_solids(others, within).min() > 0, (stamp, thing.name)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_repeats_itself_and_another_variant_is_another_scene(script: str) -> None:
    scene, other = moving_room(script), moving_room(script, 1)
    stamps = np.arange(0.5, PERIOD_S, 1.0)
    assert all(scene.at(t) == scene.at(t + PERIOD_S) for t in stamps)
    assert any(scene.at(t) != other.at(t) for t in stamps)
    assert len({scene.at(t).solids for t in stamps}) > 1


def test_the_door_opens_onto_a_room_and_closes() -> None:
    scene = moving_room("door")
    (door,) = scene.things
    middle = placed(door.solids[:1], door.stays[0].begin)[0].center
    behind = (middle[0], middle[1] - 0.8, middle[2])
    shut, wide, again = (scene.at(t).signed_distance([middle, behind]) for t in (5.0, 30.0, 55.0))
    assert shut[0] < 0 < wide[0] - 0.3
    assert again[0] == shut[0]
    assert min(shut[1], wide[1], again[1]) > 0.3


def test_frames_show_what_is_there_at_their_time(one_backend: str) -> None:
    room = opened("synthetic:room?moving=things&frames=40&width=80&height=60&noise=none")
    scene = room.moving_scene
    ball = scene.things[0]
    shown = []
    for index in (15, 25):
        frame = room.read(index)
        assert frame.stamp == index
        np.testing.assert_array_equal(frame.T_world_camera, scene.camera.pose(index))
        np.testing.assert_array_equal(frame.depth_m, room.clean_depth(index))
        points = room.camera.rays() * frame.depth_m[..., None].astype(np.float64)
        points = points.reshape(-1, 3) @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
        assert np.abs(scene.at(index).signed_distance(points)).max() < 1e-4
        shown.append((np.abs(distance_to_solids(ball.solids_at(25), points)) < 1e-4).sum())
    assert shown[0] == 0
    assert shown[1] > 50


def test_a_room_without_motion_is_the_furnished_room() -> None:
    room = opened("synthetic:room")
    assert room.moving_scene is None
    assert room.scene_at(3) is room.scene
    assert room.stamp_at(5) == 1.0
