"""Ray tables of sensors that move while they measure, on the host: points, places, copies, refusals."""

import pickle
from typing import Any

import numpy as np
import pytest
from moving_lidar import lidar, motion
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.origins import ball_of, points_at, starts_at, widened
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.unrolled import unrolled

STILL = lidar(6, 40)
POSES = motion(40)
RANGES = np.random.default_rng(0).uniform(1.0, 8.0, STILL.shape)
MOVING = RayTable.moving(STILL, POSES)
ROWS = np.array([POSES[np.arange(40) * (5 + row) // 10] for row in range(6)])
"""Poses (H, W, 4, 4) whose rows are not measured together."""
FREE, FREE_M = RayTable.of_points(
    (STILL.rays() * RANGES[..., None]).reshape(-1, 3), np.tile(POSES, (6, 1, 1))
)


def measured_points(poses: NDArray) -> NDArray:
    """(H, W, 3): each column's points, in the frame in which it was measured, moved by its pose."""
    points = np.zeros((*STILL.shape, 3))
    for v, u in np.ndindex(STILL.shape):
        T = poses[u] if poses.ndim == 3 else poses[v, u]
        points[v, u] = T[:3, :3] @ (STILL.rays()[v, u] * RANGES[v, u]) + T[:3, 3]
    return points


@pytest.mark.parametrize("poses", [POSES, ROWS], ids=["columns", "pixels"])
def test_points_are_where_their_columns_pose_puts_them(poses: NDArray) -> None:
    camera = RayTable.moving(STILL, poses)
    assert camera.has_pattern
    assert camera.measures_range
    np.testing.assert_allclose(points_at(camera, RANGES), measured_points(poses), atol=1e-5)
    v, u = np.indices(STILL.shape)
    expected = np.broadcast_to(poses[..., :3, 3], (*STILL.shape, 3))
    np.testing.assert_allclose(starts_at(camera, u, v), expected, atol=1e-6)
    between = starts_at(camera, 3.25, 2.0)
    np.testing.assert_allclose(between, 0.75 * expected[2, 3] + 0.25 * expected[2, 4], atol=1e-6)


def test_free_rays_start_where_their_point_was_measured() -> None:
    assert not FREE.has_pattern
    found, expected = points_at(FREE, FREE_M)[0], measured_points(POSES).reshape(-1, 3)
    np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)], atol=1e-5)
    again = RayTable.moving(FREE, np.tile(np.eye(4), (FREE.width, 1, 1)))
    assert again == FREE


def test_motions_follow_each_other() -> None:
    more = motion(40, 0.2, -0.1)
    np.testing.assert_allclose(
        points_at(RayTable.moving(MOVING, more), RANGES),
        points_at(RayTable.moving(STILL, more @ POSES), RANGES),
        atol=1e-5,
    )


@pytest.mark.parametrize("camera", [MOVING, RayTable.moving(STILL, ROWS), FREE])
def test_a_camera_that_moves_is_copied_whole(camera: RayTable) -> None:
    again = pickle.loads(pickle.dumps(camera))
    assert again == camera
    assert again != RayTable(camera.table if camera.has_pattern else camera.table[0])
    np.testing.assert_array_equal(again.origins_m, camera.origins_m)
    thin = camera.thinned(3)
    depth_m = np.ones(camera.shape)
    np.testing.assert_array_equal(points_at(thin, np.ones(thin.shape)), points_at(camera, depth_m)[::3, ::3])


def test_a_sensor_that_stands_still_is_the_same_camera() -> None:
    still = RayTable.moving(STILL, np.tile(np.eye(4), (40, 1, 1)))
    assert still == STILL
    assert hash(still) == hash(STILL)
    assert still.origins_m is None


@pytest.mark.parametrize("camera", [MOVING, FREE])
def test_points_on_rays_are_projected_to_their_pixels(camera: RayTable) -> None:
    rng = np.random.default_rng(0)
    u, v = rng.integers(0, camera.width, 20), rng.integers(0, camera.height, 20)
    depth_m = rng.uniform(0.5, 9.0, 20)
    points = camera.directions(u, v) * depth_m[:, None] + camera.origins(u, v)
    np.testing.assert_allclose(camera.project(points), np.stack([u, v, depth_m], axis=1), atol=1e-4)


@pytest.mark.parametrize("camera", [MOVING, FREE])
def test_boxes_and_balls_hold_all_origins(camera: RayTable) -> None:
    T = look_at((1.0, 2.0, 0.5), (3.0, 0.0, 1.0))
    starts = points_at(camera, np.zeros(camera.shape)).reshape(-1, 3)
    middle, radius = ball_of(camera)
    assert np.linalg.norm(starts - middle, axis=1).max() <= radius + 1e-9
    lower, upper = widened(camera, T, np.zeros(3), np.zeros(3))
    places = starts @ T[:3, :3].T
    assert (places >= lower - 1e-9).all()
    assert (places <= upper + 1e-9).all()


def test_neighbours_are_further_apart_where_the_sensor_is_fast() -> None:
    fast = RayTable.moving(STILL, motion(40, 40.0, 0.0))
    assert fast.pixels_per_radian < 0.5 * STILL.pixels_per_radian


def test_a_picture_of_free_rays_has_their_origins() -> None:
    picture = unrolled(FREE)
    shown = picture.source >= 0
    assert shown.any()
    starts = np.broadcast_to(picture.camera.origins_m, (*picture.camera.shape, 3))  # type: ignore[attr-defined]
    np.testing.assert_allclose(starts[shown], FREE.origins_m[0][picture.source[shown]], atol=1e-6)  # type: ignore[index]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: RayTable(STILL.rays(), np.zeros((6, 3))), r"origins_m must be of shape \(40, 3\) or"),
        (
            lambda: RayTable(STILL.rays()[0], np.zeros((1, 40, 3))),
            r"origins_m must be of shape \(40, 3\), not",
        ),
        (lambda: RayTable(STILL.rays(), np.full((40, 3), np.nan)), "the origin of column 0, row 0"),
        (lambda: RayTable.moving(STILL, POSES[:5]), r"T_camera_column must be of shape \(40, 4, 4\)"),
        (lambda: RayTable.moving(STILL, 2 * POSES), "invalid rotation"),
        (lambda: RayTable.moving(STILL, POSES * np.nan), "not finite"),
        (lambda: RayTable.of_points(np.ones((3, 3)), POSES), r"T_camera_point must be of shape \(3, 4, 4\)"),
    ],
)
def test_impossible_motions_are_refused(make: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make()
