"""The step between two images: how well each direction is determined, and that the guess is no evidence."""

import numpy as np
import pytest
from numpy.typing import NDArray
from tracked_room import frames

from taichi_mrf.alignment.levenberg import determined
from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.pairs import PairFit, fit_to
from taichi_mrf.alignment.se3 import moved, twist
from taichi_mrf.alignment.surfels import surfels_of
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.simulate import KINECT_1

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
NOISE = PolynomialNoise(KINECT_1.sigma, KINECT_1.bias)
CELLS_M = 0.05
ALONG = (0, 1, 5)
"""Components of a twist that a wall straight ahead does not show: across, down, and the turn about it."""


def wall(distance_m: float) -> OrientedPoints:
    depth_m = np.full(CAMERA.shape, distance_m, np.float32)
    return oriented_points(DepthImage.upload(depth_m, CAMERA, NOISE), 8.0)


def fit(points: OrientedPoints, other: OrientedPoints, guess: Pose, config: PoseConfig) -> PairFit:
    """Pose at which points fit what another image has measured from the origin."""
    found = fit_to(points, surfels_of(other, np.eye(4), CELLS_M), [guess], config, 0.12)
    assert found is not None
    return found


def room_points(index: int) -> OrientedPoints:
    frame = frames()[index]
    return oriented_points(DepthImage.upload(frame.depth_m, frame.camera, NOISE), 8.0)


def test_directions_that_are_hardly_determined_count_for_nothing() -> None:
    lever_m, random = 2.0, np.random.default_rng(0)
    scale = np.array([1, 1, 1, lever_m, lever_m, lever_m])
    axes = np.linalg.qr(random.normal(size=(6, 6)))[0]
    values = np.array([1e-6, 1e-3, 0.01, 0.1, 0.5, 1.0])

    def equations(kept: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.outer(scale, scale) * (axes @ np.diag(kept) @ axes.T))

    H = equations(values)
    np.testing.assert_allclose(determined(H, lever_m, 0.0), H, atol=1e-12)
    known = equations(np.where(values > 0.003, values, 0.0))
    np.testing.assert_allclose(determined(H, lever_m, 0.003), known, atol=1e-12)
    assert not determined(np.zeros((6, 6)), lever_m, 0.003).any()


@pytest.mark.parametrize("sigma", [0.01, 1e3])
def test_a_flat_wall_tells_three_directions_and_the_guess_tells_none(sigma: float) -> None:
    config = PoseConfig(translation_sigma=sigma, rotation_sigma=sigma)
    guess = moved(np.eye(4), [0.03, -0.02, 0.01, 0.0, 0.0, 0.01])
    found = fit(wall(1.98), wall(2.0), guess, config)
    assert found.directions == 3
    moved_by = twist(inverse(guess) @ found.T_world_camera)
    np.testing.assert_allclose(moved_by[list(ALONG)], 0.0, atol=1e-3)
    sigmas = 1 / np.sqrt(np.maximum(np.diag(found.information), 1e-12))
    assert (sigmas[list(ALONG)] > 0.3).all()
    assert sigmas[2] < 0.005


def test_steps_are_wrong_by_what_their_information_says() -> None:
    """Of the built-in room, where all directions are determined, with a Kinect 1's noise."""
    config = PoseConfig(translation_sigma=0.05, rotation_sigma=0.03)
    squares = []
    for index in range(0, 20, 2):
        true = inverse(frames()[index].T_world_camera) @ frames()[index + 2].T_world_camera
        found = fit(room_points(index + 2), room_points(index), true, config)
        assert found.directions == 6
        error = twist(inverse(true) @ found.T_world_camera)
        squares.append(error @ found.information @ error / 6)
    assert 0.02 < np.mean(squares) < 1.0
