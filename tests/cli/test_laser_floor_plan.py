"""The built-in building and its scans, against distances that are known in closed form."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.datasets.laser.floor_plan_scans import (
    Building,
    FloorPlanOptions,
    building,
    poses_along,
    robot_path,
    simulate_scans,
)
from taichi_mrf.datasets.laser.readers import open_scans
from taichi_mrf.datasets.laser.scans import LaserScans, beams_of
from taichi_mrf.errors import DatasetError
from taichi_mrf.evaluation.floor_plan import end_points

BUILDING = building()
EAST, NORTH, WEST, SOUTH = (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)


@pytest.mark.parametrize(
    ("origin", "direction", "distance"),
    [
        ((-6.0, 0.0), WEST, 0.8),
        ((-6.0, 0.0), EAST, 12.8),
        ((-6.0, 0.0), NORTH, 1.0),
        ((-6.0, 0.0), SOUTH, 1.0),
        ((-6.0, 0.0), (0.6, 0.8), 1.25),
        ((-4.9, 0.0), NORTH, 2.8),  # through a door, to the box in the room
        ((0.0, 0.0), NORTH, 2.8),  # through a door, to the round pillar
        ((0.15, 0.0), NORTH, 3.1 - math.sqrt(0.3**2 - 0.15**2)),
        ((3.7, 0.0), SOUTH, 2.65),
        ((-4.15, 0.0), NORTH, 4.8),  # past the box, to the outer wall
        ((-2.0, 3.0), WEST, 0.2),
    ],
)
def test_distances_in_the_building(
    origin: tuple[float, float], direction: tuple[float, float], distance: float
) -> None:
    found = BUILDING.ranges(np.array(origin), np.array([direction]))
    assert found == pytest.approx([distance])


@given(
    x=st.floats(-3, 3),
    y=st.floats(-3, 3),
    angle=st.floats(0, 2 * math.pi),
    radius=st.floats(0.1, 2.0),
    far=st.floats(2.5, 9.0),
)
def test_a_pillar_and_a_wall_by_geometry(x: float, y: float, angle: float, radius: float, far: float) -> None:
    """From the origin: a ray meets the circle if it passes the middle nearer than the radius, and the wall
    x >= far, which ends at y = -1000 and y = 1000, where x = far."""
    if math.hypot(x, y) < radius + 0.01:
        return
    world = Building(np.array([[far, -1e3, far + 1.0, 1e3]]), np.array([[x, y, radius]]))
    direction = np.array([math.cos(angle), math.sin(angle)])
    passes = abs(x * direction[1] - y * direction[0])
    along = x * direction[0] + y * direction[1]
    if abs(passes - radius) < 1e-6 or abs(direction[0]) < 1e-6:
        return
    circle = along - math.sqrt(radius**2 - passes**2) if passes < radius and along > 0 else math.inf
    beside = far * direction[1] / direction[0]
    if abs(abs(beside) - 1e3) < 1e-3:
        return
    wall = far / direction[0] if direction[0] > 0 and abs(beside) < 1e3 else math.inf
    assert world.ranges(np.zeros(2), direction[None])[0] == pytest.approx(min(circle, wall))


def test_the_way_leads_through_every_room_and_no_wall() -> None:
    points = poses_along(robot_path(), 4000)[:, :2]
    assert not BUILDING.solid(points).any()
    around = np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=-1) * 0.25
    assert not BUILDING.solid((points[:, None] + around).reshape(-1, 2)).any()
    for room in ((-4.6, 4.0), (0.0, 4.0), (4.7, 3.6), (3.7, -3.8), (-3.3, -4.2)):
        assert np.hypot(*(points - room).T).min() < 0.3


def test_poses_are_evenly_spread_and_look_ahead() -> None:
    poses = poses_along(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]]), 7)
    assert poses[:, :2].tolist() == [[0, 0], [0.5, 0], [1, 0], [1.5, 0], [2, 0], [2, 0.5], [2, 1]]
    assert poses[:, 2] == pytest.approx([0, 0, 0, 0, *[math.pi / 2] * 3])


def test_without_noise_beams_end_on_surfaces() -> None:
    scans = simulate_scans(FloorPlanOptions(scans=40, noise=0.0))
    ends = end_points(scans)
    scan, beam = np.nonzero(scans.hit)
    heading = scans.pose_x_y_theta[scan, 2] + scans.angle_rad[beam]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    assert BUILDING.solid(ends + 1e-4 * ahead).mean() > 0.999  # corners may be cut within the rounding
    assert not BUILDING.solid(ends - 1e-4 * ahead).any()
    assert scans.range_m[~scans.hit].tolist() == [8.0] * int((~scans.hit).sum())


def test_the_plan_shows_the_solids() -> None:
    plan = BUILDING.plan()
    random = np.random.default_rng(3)
    points = random.uniform((-7, -5), (7, 5), (2000, 2))
    row, column = plan.pixels(points)
    assert plan.holds(row, column).all()
    assert (plan.wall[row, column] == BUILDING.solid(points)).mean() > 0.98  # up to half a pixel at edges
    row, column = plan.pixels(np.array([[-6.99, 4.99], [-6.99, -4.99]]))
    assert row.tolist() == [0, len(plan.wall) - 1]
    assert column.tolist() == [0, 0]


def test_the_noise_is_that_of_the_options_and_depends_on_the_seed_alone() -> None:
    exact = simulate_scans(FloorPlanOptions(scans=30, noise=0.0))
    first, again, other = (simulate_scans(FloorPlanOptions(scans=30, noise=0.05, seed=s)) for s in (1, 1, 2))
    assert np.array_equal(first.range_m, again.range_m)
    assert not np.array_equal(first.range_m, other.range_m)
    inner = exact.hit & (exact.range_m > 0.3) & (exact.range_m < 7.5)
    error = (first.range_m - exact.range_m)[inner]
    assert error.std() == pytest.approx(0.05, rel=0.05)
    assert abs(error.mean()) < 4 * 0.05 / math.sqrt(error.size)


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ("scans=0", "scans"),
        ("beams=0", "beams"),
        ("noise=-1", "noise"),
        ("noise=.nan", "noise"),
        ("max_range=0", "max_range"),
        ("field_of_view=400", "field_of_view"),
        ("scan=3", "did you mean 'scans'"),
        ("scans=many", "scans"),
        ("scans", "name=value"),
    ],
)
def test_options_that_make_no_sense_are_named(query: str, word: str) -> None:
    with pytest.raises(DatasetError, match=word):
        open_scans(f"synthetic:floor-plan?{query}")


def test_options_are_taken_from_the_name() -> None:
    scans = open_scans("synthetic:floor-plan?scans=3&beams=5&field_of_view=90&max_range=2&noise=0")
    assert scans.range_m.shape == (3, 5)
    assert np.degrees(scans.angle_rad) == pytest.approx([-45, -22.5, 0, 22.5, 45])
    assert scans.range_m.max() == 2.0
    assert scans.floor_plan is not None


def two_scans(**changes: object) -> LaserScans:
    values = {
        "name": "two",
        "range_m": np.array([[1.0, 2.0], [0.0, 8.0]], dtype=np.float32),
        "angle_rad": np.array([0.0, math.pi / 2]),
        "pose_x_y_theta": np.array([[1.0, 2.0, 0.0], [3.0, 4.0, math.pi / 2]]),
        "hit": np.array([[True, True], [True, False]]),
    }
    return LaserScans(**(values | changes))  # type: ignore[arg-type]


def test_beams_leave_the_scanner_at_its_pose_and_angle() -> None:
    beams = beams_of(two_scans())
    assert beams.origins.tolist() == [[1, 2, 0], [1, 2, 0], [3, 4, 0]]
    assert beams.directions == pytest.approx(np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0]]), abs=1e-12)
    assert beams.range_m.tolist() == [1, 2, 8]
    assert beams.hit.tolist() == [True, True, False]
    assert beams.ends[:, :2] == pytest.approx(np.array([[2, 2], [1, 4], [-5, 4]]))


@pytest.mark.parametrize(
    ("of_scans", "asked", "kept"),
    [(True, None, 3), (False, None, 2), (True, False, 2), (False, True, 3)],
)
def test_beams_without_a_return_may_say_nothing(of_scans: bool, asked: bool | None, kept: int) -> None:
    assert len(beams_of(two_scans(no_return_is_free=of_scans), no_return_is_free=asked)) == kept


def test_long_beams_are_cut_and_then_hit_nothing() -> None:
    beams = beams_of(two_scans(), max_range_m=1.5)
    assert beams.range_m.tolist() == [1.0, 1.5, 1.5]
    assert beams.hit.tolist() == [True, False, False]
