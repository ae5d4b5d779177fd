"""Measurements averaged on planes: against least squares, window by window, and planes of known noise."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.noise import NoiseTable, PatchNoise, PolynomialNoise
from taichi_mrf.sensor.plane_window import (
    LEAST,
    LEAST_SHARE,
    MOST_CHI,
    MOST_REACH,
    MOST_SIGMAS,
    PlaneWindow,
    averaged_on_planes,
)
from taichi_mrf.sensor.ray_table import RayTable

CAMERA = PinholeCamera(40, 30, 50.0, 50.0, 19.5, 14.5)
SIGMA_M = 0.05
NOISE = PolynomialNoise((SIGMA_M,))
EVERYWHERE = PlaneWindow(0.12, 0.0)
PLANE = np.array([0.2, -0.1, 0.5])


def depth_of_plane(camera: Camera = CAMERA) -> NDArray[np.float64]:
    """Depth of the plane n . q = 1, about 2 m."""
    return 1.0 / (camera.rays() @ PLANE)


def averaged(
    depth_m: NDArray[np.floating],
    window: PlaneWindow = EVERYWHERE,
    noise: PolynomialNoise | PatchNoise = NOISE,
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """New depths, and the share of the old sigma that is left."""
    table = noise.table(CAMERA)
    depth, new = averaged_on_planes(depth_m.astype(np.float32), CAMERA, table, window)
    at = np.where(depth > 0, depth, 1.0).astype(np.float64)
    return depth, new.at_pixels(at)[0] / table.at_pixels(at)[0]


def window_by_window(
    z: NDArray[np.float64], sigma: float, half_side_m: float, camera: PinholeCamera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same by NumPy's least squares."""
    depth, scale = z.copy(), np.ones(z.shape)
    for row, column in np.argwhere(z > 0):
        reach = min(int(np.rint(half_side_m * camera.pixels_per_radian / z[row, column])), MOST_REACH)
        while reach > 0:
            top, left = max(row - reach, 0), max(column - reach, 0)
            v, u = np.nonzero(z[top : row + reach + 1, left : column + reach + 1])
            v, u = v + top, u + left
            if len(v) >= LEAST_SHARE * (2 * reach + 1) ** 2:
                q, root = 1 / z[v, u], z[v, u] ** 2 / sigma
                A = np.stack([np.ones(len(v)), u - column, v - row], axis=-1)
                found, *_ = np.linalg.lstsq(A * root[:, None], q * root, rcond=None)
                chi = float(np.sum(((q - A @ found) * root) ** 2)) / (len(v) - 3)
                off = abs(found[0] - 1 / z[row, column]) * z[row, column] ** 2 / sigma
                if chi < MOST_CHI and off < MOST_SIGMAS:
                    depth[row, column] = 1 / found[0]
                    scale[row, column] = np.sqrt(max(1 - min(chi, 1) * (1 - 1 / len(v)), LEAST**2))
                    break
            reach //= 2
    return depth, scale


def test_windows_are_solved_as_least_squares_does() -> None:
    rng = np.random.default_rng(3)
    z = depth_of_plane() + np.where(np.arange(40) > 22, 0.5, 0.0)  # with an edge
    z = z + rng.normal(size=z.shape) * SIGMA_M * rng.choice([0.3, 1.0, 1.3])
    z[rng.random(z.shape) < 0.15] = 0.0
    z = z.astype(np.float32).astype(np.float64)
    depth, scale = averaged(z)
    expected, expected_scale = window_by_window(z, SIGMA_M, EVERYWHERE.half_side_m, CAMERA)
    moved = expected != z
    assert 0.5 < moved[z > 0].mean() < 1.0  # planes were found, and edges
    np.testing.assert_allclose(depth, expected, rtol=2e-6, atol=0)
    np.testing.assert_allclose(scale, expected_scale, rtol=1e-5)


def test_a_plane_without_noise_stays_and_tells_nothing_of_its_errors() -> None:
    depth, scale = averaged(depth_of_plane())
    np.testing.assert_allclose(depth, depth_of_plane(), rtol=1e-6)
    np.testing.assert_allclose(scale, 1.0, atol=1e-4)


def test_independent_errors_average_out_and_shared_ones_keep_their_sigma() -> None:
    rng = np.random.default_rng(0)
    errors = SIGMA_M * rng.normal(size=CAMERA.shape)
    depth, scale = averaged(depth_of_plane() + errors)
    left = depth - depth_of_plane()
    inside = (slice(MOST_REACH, -MOST_REACH),) * 2
    # 7 x 7 pixels at 2 m; neighbours share most of theirs.
    assert np.std(left[inside]) < SIGMA_M / 4
    assert np.median(scale[inside]) == pytest.approx(LEAST, abs=0.05)
    half = 0.5 * errors + 0.5 * SIGMA_M
    _, scale = averaged(depth_of_plane() + half)
    assert np.median(scale[inside]) == pytest.approx(np.sqrt(0.75), abs=0.04)


def test_nothing_is_mixed_across_an_edge() -> None:
    step = np.where(np.arange(40) < 20, 2.0, 3.0) * np.ones(CAMERA.shape)
    rng = np.random.default_rng(1)
    depth, _ = averaged(step + SIGMA_M * rng.normal(size=step.shape))
    assert np.abs(depth - step).max() < 5 * SIGMA_M
    exact, scale = averaged(step)
    np.testing.assert_allclose(exact, step, rtol=1e-6)
    np.testing.assert_allclose(scale, 1.0, atol=1e-4)


def test_biases_of_patches_are_taken_out_and_put_back() -> None:
    sigma = np.tile([SIGMA_M, 0.0, 0.0], (12, 1))
    bias = np.random.default_rng(2).uniform(-0.03, 0.03, (12, 3))  # slopes below a fifth
    noise = PatchNoise(sigma, bias, 10, CAMERA)
    truth = depth_of_plane()
    measured = truth + noise.table(CAMERA).at_pixels(truth)[1]
    depth, _ = averaged(measured, noise=noise)
    np.testing.assert_allclose(depth, measured, atol=1e-3 * SIGMA_M)


def test_only_what_is_less_precise_than_a_voxel_is_averaged() -> None:
    noisy = depth_of_plane() + SIGMA_M * np.random.default_rng(4).normal(size=CAMERA.shape)
    noise = PolynomialNoise((0.0, 0.0, 0.0125))  # 0.05 m at 2 m
    depth, scale = averaged(noisy, PlaneWindow(0.12, SIGMA_M), noise)
    kept = noisy < 1.99
    assert kept.any()
    assert not kept.all()
    np.testing.assert_array_equal(depth[kept], noisy.astype(np.float32)[kept])
    assert (scale[kept] == 1.0).all()
    assert (scale[noisy > 2.01] < 0.99).mean() > 0.8


def test_cameras_without_a_pattern_and_noise_without_polynomials() -> None:
    points = np.random.default_rng(5).normal((0.0, 0.0, 5.0), size=(30, 3))
    free, ranges = RayTable.of_points(points)
    assert free.pixels_per_radian == 0
    new, table = averaged_on_planes(ranges, free, NOISE.table(free), EVERYWHERE)
    np.testing.assert_array_equal(new, ranges)
    assert isinstance(table, NoiseTable)
    with pytest.raises(ConfigError, match=r"inference\.plane_window"):
        averaged_on_planes(ranges, free, object(), EVERYWHERE)  # type: ignore[arg-type]
