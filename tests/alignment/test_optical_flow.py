"""Motion between two colour images, by corners that are followed."""

from dataclasses import replace

import numpy as np
import pytest
from patterned_wall import AHEAD, CAMERA, wall

from taichi_mrf.alignment.optical_flow import motion_between
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.se3 import moved, twist
from taichi_mrf.geometry.poses import inverse


@pytest.mark.parametrize(
    ("xi", "near"),
    [
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.005),
        ((0.15, 0.0, 0.0, 0.0, 0.0, 0.0), 0.005),  # 13 pixels
        ((0.05, -0.08, 0.1, 0.04, -0.1, 0.05), 0.005),
        ((0.0, 0.0, 0.0, 0.0, 0.25, 0.0), RULES.guess_m / 2),  # 35 pixels, of which few corners are left
    ],
)
def test_the_motion_is_that_of_the_camera(xi: tuple[float, ...], near: float) -> None:
    motion = motion_between(wall(AHEAD), wall(moved(AHEAD, xi), gain=1.2))
    assert motion is not None
    off = twist(inverse(moved(np.eye(4), xi)) @ motion)
    assert np.abs(off).max() < near


def test_a_part_that_moves_by_itself_is_left_out() -> None:
    xi = np.array([0.03, 0.0, 0.02, 0.0, 0.02, 0.0])
    before, now = wall(AHEAD), wall(moved(AHEAD, xi))
    assert before.color is not None
    assert now.color is not None
    before.color[:, :50], now.color[:, 6:56] = before.color[::-1, 100:150], before.color[::-1, 100:150]
    motion = motion_between(before, now)
    assert motion is not None
    assert np.abs(twist(inverse(moved(np.eye(4), xi)) @ motion)).max() < 0.005


def test_pictures_that_do_not_tell_give_no_motion() -> None:
    frame = wall(AHEAD)
    turned_away = wall(moved(AHEAD, (0, 0, 0, 0, 1.0, 0)))
    grey = replace(frame, color=np.full((*CAMERA.shape, 3), 128, np.uint8))
    noise = np.random.default_rng(0).integers(1, 255, (*CAMERA.shape, 3), np.uint8)
    blind = replace(frame, depth_m=np.zeros_like(frame.depth_m))
    for before, now in [
        (frame, turned_away),
        (grey, grey),
        (frame, replace(frame, color=noise)),
        (blind, frame),
        (replace(frame, color=None), frame),
        (frame, replace(frame, color=None)),
        (replace(frame, camera=CAMERA.scaled(0.5)), frame),
    ]:
        assert motion_between(before, now) is None
