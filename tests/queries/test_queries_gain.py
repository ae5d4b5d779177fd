"""Information that a view would give, against the sum over each ray's segments in float64."""

import dataclasses

import numpy as np
import pytest
from hand_made import VOXEL
from oracles.traversal import segments
from queried_maps import SEEN_FREE, HandMap, room_map

from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.queries.gain import pixel_gain, view_gain
from taichi_mrf.queries.survey import Occlusion
from taichi_mrf.sensor.camera import PinholeCamera

CAMERA = PinholeCamera(width=12, height=9, fx=10, fy=10.5, cx=5.8, cy=4.1)
MAX_DEPTH = 2.0
VIEWS = [
    look_at((-1.3, 2.1, -0.45), (-3.0, 2.5, -0.5)),
    look_at((-0.9, 1.3, -0.9), (-1.6, 2.2, 0.0)),
    look_at((-1.21, 1.93, 0.9), (-1.2, 2.0, 0.0)),
]
"""From within the map to its sides and its corner, and from just above it."""


def expected(hand: HandMap, T_world_camera: np.ndarray, empty_below: float = -np.inf) -> np.ndarray:
    """Sum of H times the integral of the visibility, voxel by voxel."""
    gain = np.zeros(CAMERA.shape)
    for v, u in np.ndindex(*CAMERA.shape):
        direction = T_world_camera[:3, :3] @ CAMERA.rays()[v, u]
        speed = np.linalg.norm(direction)
        cells, near, far = segments(T_world_camera[:3, 3], direction, 0.0, MAX_DEPTH, VOXEL)
        visibility = 1.0
        for log_odds, length in zip(hand.true_log_odds(cells), (far - near) * speed, strict=True):
            if log_odds == SEEN_FREE or log_odds < empty_below:
                continue
            p = 1 / (1 + np.exp(-log_odds))
            alpha = -np.log1p(-p) / VOXEL
            entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
            gain[v, u] += entropy * visibility * (1 - np.exp(-alpha * length)) / alpha / VOXEL
            visibility *= np.exp(-alpha * length)
    return gain


@pytest.mark.parametrize("view", range(len(VIEWS)))
def test_each_pixels_gain(hand: HandMap, view: int) -> None:
    wanted = expected(hand, VIEWS[view])
    found = pixel_gain(hand, CAMERA, VIEWS[view], MAX_DEPTH)
    assert wanted.max() > 1.5 * wanted.min() > 0
    # Rays lose their last thousandth of visibility in the kernel.
    np.testing.assert_allclose(found, wanted, rtol=5e-3)
    assert view_gain(hand, CAMERA, VIEWS[view], MAX_DEPTH) == pytest.approx(found.sum(), rel=1e-5)


def test_voxels_that_the_view_takes_for_empty_tell_nothing(hand: HandMap) -> None:
    see_through = dataclasses.replace(hand)
    see_through.view.occlusion = Occlusion(empty_below=-4.0)
    wanted = expected(hand, VIEWS[0], empty_below=-4.0)
    found = pixel_gain(see_through, CAMERA, VIEWS[0], MAX_DEPTH)
    np.testing.assert_allclose(found, wanted, rtol=5e-3)
    assert (wanted != expected(hand, VIEWS[0])).any()


def test_several_views_at_once(hand: HandMap) -> None:
    together = view_gain(hand, CAMERA, np.stack(VIEWS), MAX_DEPTH)
    assert together.shape == (3,)
    np.testing.assert_array_equal(together, [view_gain(hand, CAMERA, T, MAX_DEPTH) for T in VIEWS])


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_looking_at_what_is_known_tells_less(method: str) -> None:
    m = room_map(method)
    known = next(iter(m.keyframes.values())).T_world_camera
    away = look_at((0, 0, 8.0), (0, 0, 12.0))
    gains = view_gain(m, CAMERA, np.stack([known, away]), 4.0)
    assert 0 < gains[0] < gains[1]


def test_views_that_make_no_sense(hand: HandMap) -> None:
    with pytest.raises(ConfigError, match="max_depth must be"):
        pixel_gain(hand, CAMERA, VIEWS[0], -1.0)
    with pytest.raises(ConfigError, match="poses must be of shape"):
        view_gain(hand, CAMERA, np.zeros((2, 2, 4, 4)), 1.0)
    with pytest.raises(KeyframeError, match="rotation"):
        pixel_gain(hand, CAMERA, np.zeros((4, 4)) + np.diag([2, 2, 2, 1]), 1.0)
