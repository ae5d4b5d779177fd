"""Pictures of images without a flat plane: which pixel shows which ray."""

import numpy as np
import pytest

from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.sensor.unrolled import covering, unrolled

PINHOLE = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
LIDAR = SphericalCamera(np.linspace(0.5, -0.4, 32), np.linspace(np.pi, -np.pi, 200, endpoint=False))


def free(low: float, high: float, n: int = 6000) -> RayTable:
    """Rays without a pattern, evenly over the azimuths from ``low`` to ``high``."""
    rng = np.random.default_rng(0)
    a, z = rng.uniform(low, high, n), rng.uniform(-0.4, 0.45, n)
    level = np.sqrt(1 - z * z)
    return RayTable(np.stack([level * np.cos(a), level * np.sin(a), z], axis=1))


@pytest.mark.parametrize("camera", [PINHOLE, LIDAR])
def test_an_image_with_a_pattern_is_its_own_picture(camera: Camera) -> None:
    values = np.random.default_rng(0).random(camera.shape)
    picture = unrolled(camera)
    assert picture.camera is camera
    np.testing.assert_array_equal(picture.image(values), values)


@pytest.mark.parametrize(("low", "high"), [(-np.pi, np.pi), (0.3, 1.4), (2.6, 3.9)])
def test_rays_without_a_pattern_are_shown_where_they_look(low: float, high: float) -> None:
    camera = free(low, high)
    picture = unrolled(camera)
    shown = picture.source >= 0
    assert shown.mean() > 0.85
    rays, middles = camera.rays()[0][picture.source[shown]], picture.camera.rays()[shown]
    height, width = picture.camera.shape
    assert width / height == pytest.approx((high - low) / 0.88, rel=0.1)
    apart = np.arccos(np.clip((rays * middles).sum(axis=1), -1, 1))
    assert apart.max() < 0.75 * (high - low) / width * 1.1  # half a cell's diagonal
    values = np.arange(6000.0)[None]
    image = picture.image(values, np.nan)
    np.testing.assert_array_equal(np.isnan(image), ~shown)
    np.testing.assert_array_equal(image[shown], picture.source[shown])


def test_the_left_of_a_picture_is_to_the_left_and_its_top_is_up() -> None:
    rays = unrolled(free(-0.5, 0.5)).camera.rays()
    assert rays[10, 0, 1] > 0.4 > -0.4 > rays[10, -1, 1]
    assert rays[0, 5, 2] > 0.4 > -0.35 > rays[-1, 5, 2]
    rays = covering(PINHOLE, 500).rays()  # x right, y down
    assert rays[5, 0, 0] < -0.4
    assert rays[5, -1, 0] > 0.4
    assert rays[0, 5, 1] < -0.3


@pytest.mark.parametrize("camera", [PINHOLE, LIDAR, free(-np.pi, np.pi)])
def test_a_covering_camera_sees_what_the_other_sees(camera: Camera) -> None:
    grid = covering(camera, 2000)
    assert 1500 < grid.width * grid.height < 3500
    units = camera.rays().reshape(-1, 3)
    units = units / np.linalg.norm(units, axis=1, keepdims=True)
    nearest = (units[::17] @ grid.rays().reshape(-1, 3).T).max(axis=1)
    assert np.arccos(np.clip(nearest, -1, 1)).max() < 1.0 / grid.pixels_per_radian


def test_colours_are_shown_too_and_one_ray_is_a_picture() -> None:
    camera = free(0.0, 1.0)
    colors = np.zeros((1, 6000, 3), np.uint8)
    colors[..., 1] = 200
    assert (unrolled(camera).image(colors).reshape(-1, 3).max(axis=0) == [0, 200, 0]).all()
    assert unrolled(RayTable([[1.0, 0.0, 0.0]])).image(np.ones((1, 1))).tolist() == [[1.0]]
