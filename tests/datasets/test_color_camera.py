"""Colour of a camera of its own: each depth pixel gets the colour of its own point, or none."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.sensor.camera import PinholeCamera

DEPTH = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
COLOR = PinholeCamera(96, 72, 90.0, 90.0, 47.5, 35.5)
BESIDE = np.eye(4)
BESIDE[0, 3] = -0.05
WALL_M, THING_M = 2.0, 1.0
WALL, THING = np.array([20, 40, 200], np.uint8), np.array([220, 30, 10], np.uint8)


def image(camera: PinholeCamera, eye_x: float) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth and colour of a square of 0.4 m in front of a wall, as a camera at x = ``eye_x`` sees them."""
    rays = camera.rays()
    on_thing = (np.abs(rays[..., 0] * THING_M + eye_x) < 0.2) & (np.abs(rays[..., 1] * THING_M) < 0.2)
    depth = np.where(on_thing, THING_M, WALL_M).astype(np.float32)
    return depth, np.where(on_thing[..., None], THING, WALL)


def test_pixels_get_the_colour_of_their_points_and_hidden_ones_none() -> None:
    depth_m, truth = image(DEPTH, 0.0)
    _, color = image(COLOR, 0.05)
    depth_m[10, 10] = 0.0
    found = ColorCamera(COLOR, BESIDE).registered(color, depth_m, DEPTH)
    colored = found.any(axis=2)
    assert not colored[10, 10]
    # Beside the square the colour camera sees the square where the depth camera sees the wall.
    hidden = ~colored & (depth_m == WALL_M)
    assert 0.02 < hidden.mean() < 0.1
    wrong = colored & (np.abs(found.astype(int) - truth).max(axis=2) > 100)
    assert not wrong[depth_m == WALL_M].any()
    assert wrong.mean() < 0.01  # single pixels on the square's edge
    assert colored[depth_m == THING_M].all()


def test_what_the_colour_camera_does_not_see_has_no_colour_and_black_is_one() -> None:
    black = np.zeros((*COLOR.shape, 3), np.uint8)
    depth_m = np.full(DEPTH.shape, WALL_M, np.float32)
    aside = BESIDE.copy()
    aside[0, 3] = -1.0
    found = ColorCamera(COLOR, aside).registered(black, depth_m, DEPTH)
    # Its image ends at u = 0: x of a point = 1 - 47.5 / 90 * 2 m, 59 pixels from the left.
    seen = DEPTH.rays()[0, :, 0] * WALL_M - 1.0 >= -47.5 / 90 * WALL_M
    np.testing.assert_array_equal(found.any(axis=2), np.broadcast_to(seen, DEPTH.shape))
    assert (found[:, seen] == 1).all()
