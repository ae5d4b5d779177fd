"""The uncertainty of a pose as sigma of depth and as pixels that are left out: against planes that move with
the camera, closed forms, and edges that are looked for pixel by pixel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plugged_noise import PixelNoise, SquareNoise

from taichi_mrf.alignment.se3 import cross_matrix, moved
from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise, WidenedNoise
from taichi_mrf.sensor.own_evidence import checked_evidence
from taichi_mrf.sensor.pose_doubt import beside_edges, checked_covariance, covariance_of, depth_sigma
from taichi_mrf.sensor.ray_table import RayTable

# Written out, and not imported: these tests hold the values.
JUMP = 0.05
JUMP_M = 0.05
MOST_REACH = 32
STEEPEST = 0.2

PINHOLE = PinholeCamera(24, 18, 30.0, 28.0, 11.0, 9.5)
AZIMUTH, ELEVATION = np.meshgrid(np.linspace(-0.4, 0.4, 40), np.linspace(-0.2, 0.2, 9))
LIDAR = RayTable(
    np.stack(
        [np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION), np.cos(ELEVATION) * np.cos(AZIMUTH)], axis=-1
    )
)
SQUARE = SquareNoise(0.005, 0.002, 0.01)
NOISES = {
    "polynomial": PolynomialNoise((0.005, 0.0, 0.002), (0.01,)),
    "square": SQUARE,
    "of pixels": PixelNoise(np.linspace(0.004, 0.02, 432, dtype=np.float32).reshape(PINHOLE.shape)),
    "widened": WidenedNoise(SQUARE, np.array([0.01, 2.0])),
}


def random_covariance(rng: np.random.Generator) -> NDArray[np.float64]:
    A = rng.normal(size=(6, 6)) * np.repeat([0.03, 0.02], 3)[:, None]
    return A @ A.T


def depth_of_plane(camera: Camera, plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth of the plane n . q = 1 in the camera's frame."""
    return 1.0 / (camera.rays() @ plane)


def seen_from(T: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """The plane n . q = 1 of a frame whose pose is T, in the frame of that pose: n . (R q + t) = 1."""
    return (plane @ T[:3, :3]) / (1.0 - plane @ T[:3, 3])


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), lidar=st.booleans())
def test_sigma_is_what_planes_do_that_move_with_the_camera(seed: int, lidar: bool) -> None:
    rng = np.random.default_rng(seed)
    camera: Camera = LIDAR if lidar else PINHOLE
    plane = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0]) / rng.uniform(0.8, 4.0)
    covariance, depth = random_covariance(rng), depth_of_plane(camera, plane)
    # What was measured moves with the camera: in the frame of the recorded pose the plane stands elsewhere.
    step = 1e-5
    slopes = []
    for xi in step * np.eye(6):
        ends = [depth_of_plane(camera, seen_from(inverse(moved(np.eye(4), s * xi)), plane)) for s in (1, -1)]
        slopes.append((ends[0] - ends[1]) / (2 * step))
    g = np.stack(slopes, axis=-1)
    expected = np.sqrt(np.einsum("...i,ij,...j->...", g, covariance, g))
    found = depth_sigma(depth.astype(np.float32), camera, covariance)
    np.testing.assert_allclose(found, expected, rtol=2e-2)
    assert np.median(np.abs(found / expected - 1.0)) < 2e-3


def test_a_wall_straight_ahead_moves_along_the_rays_and_turns_about_its_middle() -> None:
    z, t, r = 2.0, 0.02, 0.01
    depth = np.full(PINHOLE.shape, z, np.float32)
    x, y, _ = np.moveaxis(PINHOLE.rays(), -1, 0)
    expected = np.sqrt(t**2 + r**2 * z**2 * (x**2 + y**2))
    np.testing.assert_allclose(depth_sigma(depth, PINHOLE, covariance_of(t, r)), expected, rtol=1e-5)
    sideways = np.diag([t * t, t * t, 0, 0, 0, r * r])
    np.testing.assert_allclose(depth_sigma(depth, PINHOLE, sideways), 0.0, atol=1e-6)


def test_steep_surfaces_and_noise_between_pixels_are_bounded_and_holes_are_zero() -> None:
    rng = np.random.default_rng(3)
    depth = np.where(rng.random(PINHOLE.shape) < 0.3, 0.0, rng.uniform(0.5, 5.0, PINHOLE.shape))
    sigma = depth_sigma(depth, PINHOLE, covariance_of(0.02, 0.0))
    assert (sigma[depth == 0] == 0).all()
    longest = PINHOLE.range_per_depth().max()
    assert ((sigma[depth > 0] >= 0.02 / longest) & (sigma[depth > 0] <= 0.02 / STEEPEST * 1.001)).all()
    lone = np.zeros(PINHOLE.shape)
    lone[9, 11] = 2.0
    assert depth_sigma(lone, PINHOLE, covariance_of(0.02, 0.0))[9, 11] == pytest.approx(0.02, rel=1e-2)


def test_rays_without_a_pattern_move_along_themselves_and_have_no_edges() -> None:
    units = LIDAR.rays().reshape(-1, 3)
    depth = np.where(np.arange(len(units)) % 2, 1.0, 4.0)[None]
    covariance = random_covariance(np.random.default_rng(4))
    expected = np.sqrt(np.einsum("ni,ij,nj->n", units, covariance[:3, :3], units))
    np.testing.assert_allclose(depth_sigma(depth, RayTable(units), covariance)[0], expected, rtol=1e-5)
    assert not beside_edges(depth, RayTable(units), covariance).any()


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_pixels_beside_edges_are_those_that_nearer_points_reach(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.full(PINHOLE.shape, 3.0)
    for _ in range(3):
        v, u = rng.integers(0, 18), rng.integers(0, 24)
        depth[v : v + 5, u : u + 4] = rng.choice([0.0, 0.8, 1.5, 2.95])
    covariance = 3.0 * random_covariance(rng)
    expected = np.zeros(PINHOLE.shape, bool)
    for v, u in np.argwhere(depth > 0):
        p = PINHOLE.rays()[v, u] * depth[v, u]
        J = np.hstack([np.eye(3), -cross_matrix(p)])
        C, d = J @ covariance @ J.T, p / np.linalg.norm(p)
        across = 0.5 * (np.trace(C) - d @ C @ d)
        radius = round(np.sqrt(across) / np.linalg.norm(p) * PINHOLE.pixels_per_radian)
        assert radius < MOST_REACH
        there = np.s_[max(0, v - radius) : v + radius + 1, max(0, u - radius) : u + radius + 1]
        expected[there] |= depth[there] - depth[v, u] > JUMP_M + JUMP * depth[there]
    np.testing.assert_array_equal(beside_edges(depth, PINHOLE, covariance), expected & (depth > 0))


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)
def test_the_noise_of_a_doubtful_image_is_that_of_sensor_and_pose(noise: NoiseModel) -> None:
    rng = np.random.default_rng(5)
    depth = depth_of_plane(PINHOLE, np.array([0.1, -0.2, 0.5])).astype(np.float32)
    depth[3, 4] = 0.0
    covariance = random_covariance(rng)
    stated = np.where(rng.random(depth.shape) < 0.5, 0.0, 0.04).astype(np.float32)
    of_pose = depth_sigma(depth, PINHOLE, covariance)
    for sigma_m in (None, stated):
        _, own = checked_evidence(depth, PINHOLE, None, sigma_m, covariance)
        _, exact = checked_evidence(depth, PINHOLE, None, sigma_m)
        table = own.noise_model(noise, depth).table(PINHOLE)
        of_sensor, bias = exact.noise_model(noise, depth).table(PINHOLE).at_pixels(depth)
        found, same_bias = table.at_pixels(depth)
        np.testing.assert_allclose(found, np.hypot(of_sensor, of_pose), rtol=1e-5)
        np.testing.assert_array_equal(bias, same_bias)
        assert (table.largest(depth.ravel())[0] >= found.ravel() * (1 - 1e-6)).all()
        assert own.content() != exact.content()


def test_what_is_no_covariance_is_refused() -> None:
    good = covariance_of(0.02, 0.01)
    assert checked_covariance(None) is None
    assert checked_covariance(np.zeros((6, 6))) is None
    almost = good.copy()
    almost[0, 1] = 1e-12
    C = checked_covariance(almost)
    assert C is not None
    np.testing.assert_array_equal(C, C.T)
    skew, negative, infinite = good.copy(), good.copy(), good.copy()
    skew[0, 1] = 1e-4
    negative[5, 5] = -1e-4
    infinite[2, 2] = np.nan
    for wrong, why in (
        (np.eye(3), r"pose_covariance has the shape \(3, 3\), not \(6, 6\)"),
        (skew, "pose_covariance is not symmetric: it differs from its transpose by 0.0001"),
        (negative, "pose_covariance is not positive semi-definite: an eigenvalue is -0.0001"),
        (infinite, "pose_covariance holds a value that is not finite"),
        ("wide", "pose_covariance is not a matrix of numbers"),
    ):
        with pytest.raises(KeyframeError, match=why):
            checked_evidence(np.ones(PINHOLE.shape, np.float32), PINHOLE, None, None, wrong)
