"""What is true of a room in which something moves."""

import numpy as np
import pytest

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.moving_scene import Place, distance_to_solids, placed
from taichi_mrf.datasets.synthetic.room import SyntheticRoom
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.moving_truth import CLEAR_M, NEAR_M, MovingTruth, Standing

SIZE = "&width=80&height=60"


def truth_of(script: str, frames: int = 60) -> MovingTruth:
    room = open_dataset(f"synthetic:room?moving={script}&frames={frames}{SIZE}", color=False)
    assert isinstance(room, SyntheticRoom)
    return MovingTruth(room)


def standing(truth: MovingTruth, name: str) -> Standing:
    return next(each for each in truth.standings if each.name.startswith(name))


def test_a_thing_stands_from_its_coming_to_its_leaving() -> None:
    names = [each.name for each in truth_of("things").standings]
    assert names == ["ball 20-42 s", "crate 0-24 s", "chair 0-28 s", "chair 28-60 s", "stool 32-60 s"]
    assert [each.name for each in truth_of("door").standings] == [
        "door 0-18 s",
        "door 20-40 s",
        "door 42-60 s",
    ]
    assert truth_of("walker").standings == []


def test_a_voxel_belongs_to_what_is_next_to_it_unless_a_wall_is() -> None:
    truth = truth_of("things")
    ball = standing(truth, "ball")
    x, y, z = ball.solids[0].center
    radius = ball.solids[0].half_size[0]
    points = np.array([
        (x, y, z + radius), (x, y, z + radius + 0.9 * NEAR_M), (x, y, z + radius + 1.1 * NEAR_M), (x, y, z),
        (x, y, z - radius), (x + 1.0, y, z),
    ])  # fmt: skip
    floor_m = truth.scene.static.signed_distance(points[4])[0]
    assert floor_m < CLEAR_M
    expected = [True, True, False, True, False, False]
    assert truth.belong(ball, points, 25.0).tolist() == expected
    assert truth.belong(ball, points, 50.0).tolist() == expected


def test_what_stands_in_the_place_now_is_no_ghost() -> None:
    truth = truth_of("door")
    shut = standing(truth, "door 0")
    middle = np.array([shut.solids[0].center])
    assert truth.belong(shut, middle, 5.0)[0]
    assert truth.belong(shut, middle, 30.0)[0]
    assert not truth.belong(shut, middle, 50.0)[0]  # the door is shut again


def test_the_swept_volume_is_what_the_person_fills_at_some_time() -> None:
    truth = truth_of("walker")
    swept = truth.swept(0.1)
    (person,) = truth.scene.things
    on_the_way = [person.solids_at(t)[2].center for t in (19.5, 21.0, 24.0, 42.0)]
    assert swept.has(np.array(on_the_way)).all()
    on_the_floor = [(x, y, truth.scene.camera.target[2] - 0.75) for x, y, _ in on_the_way]
    assert not swept.has(np.array(on_the_floor)).any()
    centres = np.random.default_rng(0).uniform((-1, -3, -1), (3, 0, 0.5), (4000, 3))
    stamps = np.arange(0.0, 60.0, 0.2)
    nearest = np.min([distance_to_solids(person.solids_at(t), centres) for t in stamps], axis=0)
    clear = truth.scene.static.signed_distance(centres) > 2 * CLEAR_M
    assert swept.has(centres[(nearest < -0.09) & clear]).all()
    assert not swept.has(centres[nearest > 0.15]).any()
    assert len(truth_of("things").swept(0.1)) == 0


def test_what_is_new_was_not_in_its_place_at_the_start() -> None:
    truth = truth_of("things")
    assert truth.newly_there(5.0) == ()
    ball = standing(truth, "ball").solids
    assert truth.newly_there(22.0) == ball == truth.newly_there(22.0, within_s=3.0)
    assert truth.newly_there(24.0, within_s=3.0) == ()
    walker = truth_of("walker")
    assert walker.newly_there(20.0, within_s=1.0) == walker.scene.solids_of_things(20.0)


def test_a_view_sees_a_thing_and_that_it_has_gone(one_backend: str) -> None:
    truth = truth_of("things")
    ball = standing(truth, "ball")
    for index in (25, 50):
        points = truth.surface_points(index)
        there = (np.abs(distance_to_solids(ball.solids, points)) < 1e-3).any()
        assert there == (index == 25)
        assert truth.sees(ball, index)
    T = truth.room.pose(25)
    for ahead_m, seen in ((1.5, True), (-1.5, False)):
        x, y, z = T[:3, 3] + ahead_m * T[:3, 2]
        moved = placed(ball.thing.solids, Place(x, y, z - 0.3))
        assert truth.sees(Standing(ball.thing, moved, 20.0, 42.0), 25) == seen


def test_a_frame_without_things_has_the_same_noise(one_backend: str) -> None:
    truth = truth_of("walker")
    before, during = truth.room.read(5), truth.room.read(22)
    np.testing.assert_array_equal(truth.frame_without_things(5).depth_m, before.depth_m)
    bare = truth.frame_without_things(22)
    differs = bare.depth_m != during.depth_m
    assert 0.01 < differs.mean() < 0.4
    assert (bare.depth_m[differs] > 0).mean() > 0.5
    assert bare.stamp == 22.0


def test_walls_are_surfaces_that_are_seen_and_never_move(one_backend: str) -> None:
    truth = truth_of("things", frames=30)
    points = truth.surface_points(10)
    static = np.abs(truth.scene.static.signed_distance(points)) < 1e-3
    places = [solid for each in truth.standings for solid in each.solids]
    clear = static & (distance_to_solids(places, points) > CLEAR_M)
    assert truth.walls(points, 0.05)[clear].mean() > 0.9
    assert not truth.walls(points, 0.05)[~clear].any()
    behind = points + 0.3 * (points - truth.room.pose(10)[:3, 3])
    assert truth.walls(behind[clear], 0.05).mean() < 0.2


def test_the_truth_needs_motion_and_ends_with_the_script() -> None:
    room = open_dataset("synthetic:room")
    assert isinstance(room, SyntheticRoom)
    with pytest.raises(ConfigError, match="nothing moves"):
        MovingTruth(room)
    with pytest.raises(ConfigError, match="60 s, not for 61 frames"):
        truth_of("door", frames=61)
