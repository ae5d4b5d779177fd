"""The simulated sensor: its noise has the moments that were asked for, and the right pixels drop out."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.sensor.simulate import KINECT_1, SimulatedSensor, incidence, simulate

CAMERA = PinholeCamera(width=320, height=240, fx=262.5, fy=262.5, cx=159.5, cy=119.5)
PERFECT = SimulatedSensor(sigma=(0.0,))


def wall(depth: float) -> NDArray[np.float32]:
    """A wall square to the optical axis."""
    return np.full(CAMERA.shape, depth, np.float32)


def plane(normal: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Axial depth of the plane normal . x = distance, 0 where it is not met."""
    facing = CAMERA.rays() @ normal
    return np.where(facing > 1e-3, distance / np.maximum(facing, 1e-3), 0.0)


@pytest.mark.parametrize("depth", [0.8, 2.0, 4.0])
def test_mean_and_deviation_follow_the_polynomials(depth: float) -> None:
    sensor = SimulatedSensor(sigma=(0.01, -0.00095, 0.00857), bias=(0.002, -0.01, 0.004))
    measured = simulate(wall(depth), CAMERA, sensor, seed=3).astype(np.float64)
    sigma = 0.01 - 0.00095 * depth + 0.00857 * depth**2
    bias = 0.002 - 0.01 * depth + 0.004 * depth**2
    n = measured.size
    assert (measured > 0).all()
    # five standard errors of a mean and of a deviation
    assert abs(measured.mean() - depth - bias) < 5 * sigma / np.sqrt(n)
    assert abs(measured.std() - sigma) < 5 * sigma / np.sqrt(2 * n)


def test_the_default_is_the_published_kinect() -> None:
    sigma = np.polynomial.polynomial.polyval(3.0, SimulatedSensor().sigma)
    assert sigma == pytest.approx(0.0012 + 0.0019 * (3.0 - 0.4) ** 2, abs=1e-5)  # the paper's own form


@given(st.integers(0, 2**31), st.integers(0, 1000))
def test_the_same_seed_gives_the_same_image(seed: int, index: int) -> None:
    small = PinholeCamera(width=8, height=6, fx=7, fy=7, cx=3.5, cy=2.5)
    clean = np.full(small.shape, 2.0, np.float32)
    once = simulate(clean, small, seed=(seed, index))
    np.testing.assert_array_equal(once, simulate(clean, small, seed=(seed, index)))
    assert (once != simulate(clean, small, SimulatedSensor(), seed=(seed, index + 1))).any()


def test_negative_sigma_adds_no_noise() -> None:
    measured = simulate(wall(2.0), CAMERA, SimulatedSensor(sigma=(0.01, -0.02)), seed=0)
    np.testing.assert_array_equal(measured, wall(2.0))


@pytest.mark.parametrize("depth", [0.6, 1.0, 3.1, 7.0])
def test_steps_of_disparity(depth: float) -> None:
    sensor = dataclasses.replace(SimulatedSensor(), depth_step=0.00285)
    measured = simulate(wall(depth), CAMERA, sensor, seed=1).astype(np.float64)
    counts = 1 / (measured * 0.00285)
    np.testing.assert_allclose(counts, np.round(counts), rtol=1e-6)
    rounding = simulate(wall(depth), CAMERA, dataclasses.replace(PERFECT, depth_step=0.00285))
    assert np.abs(rounding - depth).max() <= 0.51 * 0.00285 * depth**2


def test_missing_and_out_of_range_stay_without_measurement() -> None:
    clean = wall(2.0)
    clean[0, :6] = (0.0, np.nan, -1.0, np.inf, 0.1, 9.0)
    measured = simulate(clean, CAMERA, PERFECT)
    assert (measured[0, :6] == 0).all()
    assert np.isfinite(measured).all()
    np.testing.assert_array_equal(measured[2:], clean[2:])


def test_pixels_on_both_sides_of_a_jump_drop_out() -> None:
    clean = wall(2.0)
    clean[:, 160:] = 3.0
    measured = simulate(clean, CAMERA, PERFECT)
    lost = np.flatnonzero((measured == 0).all(axis=0))
    np.testing.assert_array_equal(lost, [159, 160])
    assert (measured[:, :159] == 2.0).all()
    assert (measured[:, 161:] == 3.0).all()


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0, 1.3])
@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_incidence_is_the_angle_to_a_planes_normal(tilt: float, turn: float) -> None:
    normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    depth = plane(normal, 1.5)
    rays = CAMERA.rays() / CAMERA.range_per_depth()[..., None]
    expected = np.arccos(np.clip(rays @ normal, -1, 1))
    inner = np.zeros(CAMERA.shape, bool)
    inner[1:-1, 1:-1] = True
    for rows in (slice(None, -2), slice(2, None)):  # all neighbours on the plane
        inner[1:-1] &= depth[rows] > 0
    for columns in (slice(None, -2), slice(2, None)):
        inner[:, 1:-1] &= depth[:, columns] > 0
    inner &= depth > 0
    assert inner.sum() > 1000
    np.testing.assert_allclose(incidence(depth, CAMERA)[inner], expected[inner], atol=1e-5)


def test_a_grazing_floor_drops_out_beyond_its_angle() -> None:
    floor = plane(np.array([0.0, 1.0, 0.0]), 1.2)
    sensor = dataclasses.replace(PERFECT, largest_incidence=np.deg2rad(75), largest_jump=10.0, max_depth=1e3)
    seen = simulate(floor.astype(np.float32), CAMERA, sensor) > 0
    rays = CAMERA.rays() / CAMERA.range_per_depth()[..., None]
    angle = np.rad2deg(np.arccos(rays[..., 1]))  # over 90 degrees: above the horizon
    assert seen[angle < 74.5].all()
    assert not seen[angle > 75.5].any()


def test_kinect_noise_is_unbiased_in_spite_of_its_steps() -> None:
    measured = simulate(wall(3.05), CAMERA, KINECT_1, seed=5).astype(np.float64)
    step = 0.00285 * 3.05**2
    assert abs(measured.mean() - 3.05) < 0.02 * step
