"""Thin posts are not carved away by the rays that pass beside them, nor do they fill the gaps: a fence before
a wall, seen by a lidar whose beams are cones. A beam that is partly blocked returns from the fence if that
share of its light is enough, else from the wall."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.spherical import SphericalCamera

pytestmark = pytest.mark.usefixtures("one_backend")

SIGMA_M, BEAM_RAD = 0.02, 0.003
SHIFT = np.array([0.013, 0.037, 0.031])
"""Of everything against the grid."""
FENCE_M, POST_M, GAP_M, POST_HEIGHT_M, WALL_M = 12.0, 0.04, 0.25, 2.0, 10.0
"""y of the fence; width of its posts, from post to post, and their height; how far the wall is behind it."""
RINGS = ((0.0, 1), (0.33, 6), (0.66, 12), (1.0, 18))
"""Rays that stand for a beam: share of its radius, and how many there."""
ENOUGH = 0.15
"""Share of the light from which on the nearer of two surfaces gives the return."""


CAMERA = SphericalCamera(np.radians(np.linspace(4.0, -8.0, 32)), np.radians(np.arange(65.0, 115.0, 0.35)))
"""The fence is to its left, at 90 degrees."""


def cones() -> NDArray[np.float64]:
    """Rays (H, W, n, 3) that stand for the beams."""
    directions = CAMERA.rays()
    sideways = np.cross(directions, (0.0, 0.0, 1.0))
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    upwards = np.cross(directions, sideways)
    rays = []
    for radius, count in RINGS:
        for angle in 2 * np.pi * np.arange(count) / count:
            beside = np.cos(angle) * sideways + np.sin(angle) * upwards
            ray = directions + 0.5 * BEAM_RAD * radius * beside
            rays.append(ray / np.linalg.norm(ray, axis=-1, keepdims=True))
    return np.stack(rays, axis=-2)


def ranges(eye: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W) of what the beams measure from ``eye``."""
    rays, centre = cones(), CAMERA.rays()
    to_fence = (FENCE_M - eye[1]) / rays[..., 1]
    at_fence = eye + to_fence[..., None] * rays
    blocked = (
        (at_fence[..., 0] % GAP_M < POST_M) & (at_fence[..., 2] > 0) & (at_fence[..., 2] < POST_HEIGHT_M)
    )
    ground = np.where(centre[..., 2] < 0, -eye[2] / np.minimum(centre[..., 2], -1e-9), np.inf)
    behind = np.minimum((FENCE_M + WALL_M - eye[1]) / centre[..., 1], ground)
    nearer = (blocked.mean(axis=-1) >= ENOUGH) & (to_fence[..., 0] < ground)
    measured = np.where(nearer, to_fence[..., 0], behind) + rng.normal(0.0, SIGMA_M, behind.shape)
    return measured.astype(np.float32)


def mapped(voxel_size: float, pass_through: float = 0.0) -> MRFMap:
    """The map of eight scans along the fence."""
    rng = np.random.default_rng(0)
    m = MRFMap(voxel_size, PolynomialNoise((SIGMA_M,)), max_depth=60.0, pass_through=pass_through)
    for x in np.linspace(-3.0, 3.0, 8):
        eye, T = np.array([x, 0.0, 1.6]), np.eye(4)
        T[:3, 3] = eye + SHIFT
        m.add_keyframe(ranges(eye, rng), T, CAMERA)
    m.infer()
    return m


def post_points(aside_m: float = 0.0) -> NDArray[np.float64]:
    """Points (N, 3) on the middle lines of posts, or so far beside them."""
    x = np.arange(-2.0, 2.0, GAP_M) + 0.5 * POST_M + aside_m
    points = np.stack(np.meshgrid(x, [FENCE_M], np.arange(0.3, 1.6, 0.05), indexing="ij"), -1)
    return points.reshape(-1, 3) + SHIFT


def test_posts_of_a_fence_stay_and_gaps_stay_open() -> None:
    m = mapped(0.05)
    posts, gaps = (m.state(post_points(aside)) for aside in (0.0, 0.5 * GAP_M))
    assert (posts == OCCUPIED).mean() > 0.5
    assert (gaps == FREE).mean() > 0.5
    assert (gaps == OCCUPIED).mean() < 0.02
    read = m.calibrated()
    posts, gaps = (read.state(post_points(aside)) for aside in (0.0, 0.5 * GAP_M))
    assert (posts == OCCUPIED).mean() > 0.7
    assert (posts == FREE).mean() < 0.15
    assert (gaps == OCCUPIED).mean() < 0.02


def test_posts_stay_in_voxels_wider_than_they_are_more_so_if_rays_may_pass() -> None:
    """Others are unknown, because the next post is but two voxels away; none is called free."""
    shares, likelier = {}, {}
    for pass_through in (0.0, 0.1):
        m = mapped(0.1, pass_through)
        posts, gaps = (m.state(post_points(aside)) for aside in (0.0, 0.5 * GAP_M))
        shares[pass_through] = (posts == OCCUPIED).mean()
        likelier[pass_through] = (m.marginals.occupancy(post_points()) > 0.5).mean()
        assert (gaps == FREE).mean() > 0.9
        assert not (posts == FREE).any()
    assert shares[0.1] > 0.9
    assert likelier[0.0] + 0.1 < shares[0.0] < shares[0.1]
