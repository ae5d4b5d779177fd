"""Clouds as images of beams and columns: a spinning lidar's rays come back, those without a return too."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.datasets.ros.lidar import by_ring, organised
from taichi_mrf.sensor.spherical import SphericalCamera

ELEVATIONS = np.linspace(0.4, -0.3, 6)
AZIMUTHS = 1.0 - 2 * np.pi * np.arange(32) / 32
LOST = np.random.default_rng(3).random((6, 32)) < 0.3


def lidar(offsets: NDArray | None = None) -> SphericalCamera:
    return SphericalCamera(ELEVATIONS, AZIMUTHS, offsets)


def scan(camera: SphericalCamera, nothing: float = np.nan) -> NDArray:
    """Points (H, W, 3) at random ranges, some without a return."""
    ranges = np.random.default_rng(1).uniform(2.0, 9.0, camera.shape)
    points = camera.rays() * ranges[..., None]
    points[LOST] = nothing
    return points


@pytest.mark.parametrize("nothing", [np.nan, 0.0])
@pytest.mark.parametrize("offsets", [None, np.array([0.05, -0.04, 0.0, 0.02, 0.06, -0.03])])
def test_all_rays_come_back(nothing: float, offsets: NDArray | None) -> None:
    camera = lidar(offsets)
    found = organised(scan(camera, nothing))
    assert found is not None
    image, numbers = found
    table, range_m = image.camera, image.range_m
    np.testing.assert_array_equal(image.no_return, LOST)
    np.testing.assert_array_equal(numbers, np.arange(LOST.size).reshape(LOST.shape))
    np.testing.assert_array_equal(range_m > 0, ~LOST)
    np.testing.assert_allclose(table.rays(), camera.rays(), atol=1e-6)
    np.testing.assert_allclose((table.rays() * range_m[..., None])[~LOST], scan(camera)[~LOST], atol=1e-5)


def test_rows_that_are_whole_columns_ahead_are_shifted_back() -> None:
    camera = lidar()
    shifts = [0, 3, 0, -2, 9, 1]
    staggered = np.stack(
        [np.roll(row, shift, axis=0) for shift, row in zip(shifts, scan(camera), strict=True)]
    )
    found, plain = organised(staggered), organised(scan(camera))
    assert plain is not None
    rays = found[0].camera.rays()
    across = np.diff(np.unwrap(np.arctan2(rays[..., 1], rays[..., 0]), axis=0), axis=0)
    assert np.abs(across).max() < 1e-5, "a column has one azimuth"
    np.testing.assert_array_equal(found[0].no_return.sum(axis=1), LOST.sum(axis=1))
    ranges = (np.sort(each.range_m, axis=None) for each, _ in (found, plain))
    np.testing.assert_allclose(*ranges)
    points, measured = staggered.reshape(-1, 3)[found[1]], found[0].range_m > 0
    np.testing.assert_allclose(
        np.linalg.norm(points, axis=-1)[measured], found[0].range_m[measured], rtol=1e-6
    )


def test_a_row_without_a_return_lies_between_its_neighbours() -> None:
    points = scan(lidar())
    points[2] = np.nan
    found = organised(points)
    np.testing.assert_allclose(found[0].camera.rays()[2], lidar().rays()[2], atol=1e-6)


def test_points_in_no_order_are_no_image() -> None:
    points = scan(lidar()).reshape(-1, 3)
    assert organised(np.random.default_rng(2).permutation(points).reshape(6, 32, 3)) is None
    assert organised(points[None]) is None
    assert organised(np.full((6, 32, 3), np.nan)) is None


def test_a_part_of_a_turn_whose_rows_are_ahead_is_no_image() -> None:
    part = scan(lidar())[:, :12]
    assert organised(part) is not None
    assert organised(np.stack([np.roll(row, 2 * i, axis=0) for i, row in enumerate(part)])) is None


def test_rings_make_an_image_if_they_are_equally_long() -> None:
    points = scan(lidar())
    ring = np.repeat(np.array([5, 4, 3, 2, 1, 0]), 32)
    order = np.argsort(np.tile(np.arange(32), 6), kind="stable")  # column by column, as drivers write
    numbers = by_ring(points.reshape(-1, 3)[order], ring[order])
    assert numbers is not None
    np.testing.assert_array_equal(points.reshape(-1, 3)[order][numbers], points)
    assert by_ring(points.reshape(-1, 3)[1:], ring[1:]) is None
    assert by_ring(points.reshape(-1, 3), np.zeros(192, int)) is None
