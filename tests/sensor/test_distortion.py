"""A pinhole with a distortion: its rays are those that OpenCV projects to the pixels."""

import pickle

import cv2
import numpy as np
import pytest

from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.distortion import DistortedCamera
from taichi_mrf.sensor.ray_table import RayTable

PINHOLE = PinholeCamera(40, 30, 35.0, 33.0, 20.5, 13.5)
MATRIX = np.array([[35.0, 0, 20.5], [0, 33.0, 13.5], [0, 0, 1]])


@pytest.mark.parametrize(
    "coefficients",
    [(-0.25, 0.06, 0.001, -0.002), (0.1, -0.05, 0.0, 0.0, 0.02), (0.1, 0.02, 0, 0, 0.01, 0.05, 0.01, 0.001)],
)
def test_rays_are_projected_to_their_pixels_again(coefficients: tuple[float, ...]) -> None:
    camera = DistortedCamera(PINHOLE, coefficients)
    assert isinstance(camera, Camera)
    assert camera.shape == PINHOLE.shape
    assert not camera.measures_range
    rays = camera.rays()
    np.testing.assert_array_equal(rays[..., 2], 1.0)
    zero = np.zeros(3)
    pixels = cv2.projectPoints(rays.reshape(-1, 1, 3), zero, zero, MATRIX, np.array(coefficients))[0]
    v, u = np.indices(PINHOLE.shape)
    np.testing.assert_allclose(pixels.reshape(30, 40, 2), np.stack([u, v], axis=-1), atol=1e-3)
    assert np.abs(rays - PINHOLE.rays()).max() > 0.01
    again = pickle.loads(pickle.dumps(camera))
    assert again == camera
    assert again.coefficients.tolist() == list(coefficients)


def test_no_distortion_is_the_pinhole() -> None:
    assert DistortedCamera(PINHOLE, (0.0,) * 5) == RayTable(PINHOLE.rays())


@pytest.mark.parametrize(
    ("coefficients", "words"),
    [
        ((0.1, 0.0), "4, 5, 8, 12, 14 finite coefficients"),
        ((0.1, np.nan, 0.0, 0.0), "finite coefficients"),
        ((-2.0, 0.0, 0.0, 0.0), "gives column 0, row 0 no ray"),
    ],
)
def test_impossible_distortions_are_refused(coefficients: tuple[float, ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        DistortedCamera(PINHOLE, coefficients)
