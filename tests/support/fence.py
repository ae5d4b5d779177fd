"""A fence of thin posts before a wall, seen by a lidar whose beams are cones.

A beam that is partly blocked returns from the fence if that share of its light is enough, else from the wall.
As a program it prints how much of the posts is left in maps of single rays, of several rays through each
cone, and of single rays that may pass through an occupied voxel.
"""

import sys

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.system import runtime

SIGMA_M, BEAM_RAD = 0.02, 0.003
SHIFT = np.array([0.013, 0.037, 0.031])
"""Of everything against the grid."""
POST_M, GAP_M, POST_HEIGHT_M, WALL_M = 0.04, 0.25, 2.0, 10.0
"""Width of the posts, from post to post, their height, and how far behind them the wall is."""
RINGS = ((0.0, 1), (0.33, 6), (0.66, 12), (1.0, 18))
"""Rays that stand for a beam: share of its radius, and how many there."""
FIRST, STRONGEST = 0.15, 0.5
"""Share of the light from which on the nearer of two surfaces gives the return."""


def lidar(columns: NDArray[np.float64], rows: int = 48) -> SphericalCamera:
    """``columns`` are azimuths in degrees; the fence is to the left, at 90."""
    return SphericalCamera(np.radians(np.linspace(4.0, -8.0, rows)), np.radians(columns))


def cone(directions: NDArray[np.float64], rings: tuple[tuple[float, int], ...]) -> NDArray[np.float64]:
    """Rays (..., n, 3) around directions (..., 3)."""
    sideways = np.cross(directions, (0.0, 0.0, 1.0))
    sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
    upwards = np.cross(directions, sideways)
    rays = []
    for radius, count in rings:
        for angle in 2 * np.pi * np.arange(count) / count:
            beside = np.cos(angle) * sideways + np.sin(angle) * upwards
            ray = directions + 0.5 * BEAM_RAD * radius * beside
            rays.append(ray / np.linalg.norm(ray, axis=-1, keepdims=True))
    return np.stack(rays, axis=-2)


def ranges(
    eye: NDArray[np.float64], camera: SphericalCamera, fence_m: float, enough: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """(H, W) of what the beams measure from ``eye``; the fence is the plane y = ``fence_m``."""
    rays = cone(camera.rays(), RINGS)
    to_fence = (fence_m - eye[1]) / rays[..., 1]
    at_fence = eye + to_fence[..., None] * rays
    blocked = (
        (at_fence[..., 0] % GAP_M < POST_M) & (at_fence[..., 2] > 0) & (at_fence[..., 2] < POST_HEIGHT_M)
    )
    centre = camera.rays()
    ground = np.where(centre[..., 2] < 0, -eye[2] / np.minimum(centre[..., 2], -1e-9), np.inf)
    behind = np.minimum((fence_m + WALL_M - eye[1]) / centre[..., 1], ground)
    nearer = (blocked.mean(axis=-1) >= enough) & (to_fence[..., 0] < ground)
    measured = np.where(nearer, to_fence[..., 0], behind) + rng.normal(0.0, SIGMA_M, behind.shape)
    return measured.astype(np.float32)


def mapped(
    camera: SphericalCamera, fence_m: float, voxel_size: float, enough: float, scans: int, rays: int = 1,
    pass_through: float = 0.0,
) -> MRFMap:  # fmt: skip
    """The map of scans along the fence, with one ray for each beam, or ``rays`` through its cone."""
    noise = PolynomialNoise((SIGMA_M,))
    rng, m = np.random.default_rng(0), MRFMap(voxel_size, noise, max_depth=60.0, pass_through=pass_through)
    of_map: RayTable = camera
    if rays > 1:
        some = cone(camera.rays(), ((0.0, 1), (0.7, rays - 1)))
        of_map = RayTable(some.reshape(camera.height, -1, 3))
    for x in np.linspace(-3.0, 3.0, scans):
        eye, T = np.array([x, 0.0, 1.6]), np.eye(4)
        T[:3, 3] = eye + SHIFT
        measured = ranges(eye, camera, fence_m, enough, rng)
        m.add_keyframe(np.repeat(measured, rays, axis=1), T, of_map)
    m.infer()
    return m


def post_points(fence_m: float, aside_m: float = 0.0) -> NDArray[np.float64]:
    """Points (N, 3) on the middle lines of posts, or so far beside them."""
    x = np.arange(-2.0, 2.0, GAP_M) + 0.5 * POST_M + aside_m
    points = np.stack(np.meshgrid(x, [fence_m], np.arange(0.3, 1.6, 0.05), indexing="ij"), -1)
    return points.reshape(-1, 3) + SHIFT


def main() -> None:
    """Print the figures of docs/decisions.md."""
    runtime.init("cpu")
    camera = lidar(np.arange(20.0, 160.0, 0.35))
    for enough in (FIRST, STRONGEST):
        for voxel_size in (0.1, 0.05):
            for fence_m in (12.0, 20.0, 30.0):
                said = []
                for rays, pass_through in ((1, 0.0), (5, 0.0), (1, 0.1)):
                    m = mapped(camera, fence_m, voxel_size, enough, 8, rays, pass_through)
                    for view in (m, m.calibrated()):
                        posts, gaps = (view.state(post_points(fence_m, a)) for a in (0.0, 0.5 * GAP_M))
                        shares = (posts == OCCUPIED).mean(), (posts == FREE).mean(), (gaps == OCCUPIED).mean()
                        said.append(" ".join(f"{share:.2f}" for share in shares))
                print(enough, voxel_size, fence_m, " | ".join(said), flush=True)


if __name__ == "__main__":
    sys.exit(main())
