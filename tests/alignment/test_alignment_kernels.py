"""The kernels of alignment against an oracle, closed forms and finite differences."""

import numpy as np
import pytest
from numpy.typing import NDArray
from oracles.alignment import plane_normal, summed

from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.point_to_plane import PointToPlane
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.surfels import Surfels, merged, surfels_of
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

# Written out, and not imported: these tests hold the values.
STRIDE = 2
ALIKE = 0.7
LEAST_WEIGHT = 0.001
REACH = 0.6
ROUGHNESS = 0.2

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]

CAMERA = PinholeCamera(width=80, height=60, fx=200.0, fy=190.0, cx=38.0, cy=31.0)
HALF = 3  # pixels, at this focal length
NOISE = PolynomialNoise((0.002, 0.0, 0.001), (0.01,))
CELL = 0.1


def plane_depth(normal: NDArray, distance: float) -> NDArray[np.float32]:
    """Axial depth of the plane -normal . p = distance in front of the camera."""
    return (distance / -(CAMERA.rays() @ normal)).astype(np.float32)


def points_of(depth_m: NDArray[np.float32], max_depth: float = 10.0) -> OrientedPoints:
    return oriented_points(DepthImage.upload(depth_m, CAMERA, NOISE), max_depth)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.5, 0.2, -0.8), (-0.7, 0.6, -0.5)])
def test_a_plane_has_its_normal_everywhere(normal: tuple) -> None:
    n = np.array(normal) / np.linalg.norm(normal)
    found = points_of(plane_depth(n, 1.5))
    assert len(found.points) > 0.8 * 40 * 30
    np.testing.assert_allclose(found.normals, np.broadcast_to(n, found.normals.shape), atol=2e-3)
    rays = CAMERA.rays()[found.places[:, 1] * STRIDE, found.places[:, 0] * STRIDE]
    # The bias of 1 cm is taken out of every depth.
    depth = 1.5 / -(rays @ n) - 0.01
    np.testing.assert_allclose(found.points, rays * depth[:, None], atol=1e-5)
    np.testing.assert_allclose(found.sigmas, -(rays @ n) * (0.002 + 0.001 * depth**2), rtol=1e-4)


def test_normals_of_a_rough_surface_follow_the_oracle() -> None:
    random = np.random.default_rng(0)
    depth = plane_depth(np.array([0.3, -0.2, -0.93]), 2.0) + random.normal(0, 0.004, CAMERA.shape)
    found = points_of(depth.astype(np.float32))
    inner = (found.places >= 2).all(axis=1) & (found.places < (38, 28)).all(axis=1)
    chosen = np.flatnonzero(inner)[::17]
    assert len(chosen) > 40
    for i in chosen:
        u, v = found.places[i] * STRIDE
        expected = plane_normal(depth, CAMERA, int(u), int(v), HALF)
        np.testing.assert_allclose(found.normals[i], expected, atol=2e-3)


def test_no_point_lies_beside_a_jump_or_a_hole() -> None:
    depth = plane_depth(np.array([0.0, 0.0, -1.0]), 1.0)
    depth[:, 40:] = 2.0
    depth[:, :6] = 0.0
    found = points_of(depth, max_depth=1.9)
    columns = found.places[:, 0] * STRIDE
    # A window that reaches over the jump has too few pixels of its own side only beyond it.
    assert columns.min() >= 6
    assert columns.max() < 40
    np.testing.assert_allclose(found.normals, np.broadcast_to([0, 0, -1], found.normals.shape), atol=1e-4)
    assert len(points_of(np.zeros(CAMERA.shape, np.float32)).points) == 0


def corner(T: Pose) -> OrientedPoints:
    """Three walls that meet at the world's origin, as a camera at T sees them, a little rough."""
    rays = CAMERA.rays() @ T[:3, :3].T
    depth = np.min(np.where(rays < 0, -T[:3, 3] / np.minimum(rays, -1e-9), np.inf), axis=-1)
    random = np.random.default_rng(1)
    return points_of((depth + 0.01 + random.normal(0, 0.002, depth.shape)).astype(np.float32))


VIEWS = [look_at((1.5, 1.2, 1.0), (0.1, 0.1, 0.1)), look_at((1.0, 1.6, 1.2), (0.1, 0.0, 0.2))]


@pytest.fixture(scope="module")
def surfels(backend: str) -> Surfels:
    return merged([surfels_of(corner(T), T, CELL) for T in VIEWS], CELL)


def thinned(points: OrientedPoints) -> OrientedPoints:
    return points.thinned(3)


@pytest.mark.parametrize("step", [np.zeros(6), (0.02, -0.03, 0.01, 0.01, -0.02, 0.015), (0, 0, 9, 0, 0, 0)])
def test_sums_follow_the_oracle(surfels: Surfels, step: NDArray) -> None:
    points, T = thinned(corner(VIEWS[0])), moved(VIEWS[0], step)
    found = PointToPlane(points, SurfelGrid(surfels)).linearised(T)
    expected = summed(
        points.points, points.normals, points.sigmas, T, surfels.planes(), CELL,
        reach=REACH, alike=ALIKE, least_weight=LEAST_WEIGHT, roughness=ROUGHNESS,
    )  # fmt: skip
    assert found.total == len(points.points) > 100
    # A point on the very border of a cell may round to either side of it.
    assert abs(found.matched - expected.matched) <= 1
    np.testing.assert_allclose(found.weight, expected.weight, rtol=1e-2)
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-2)
    np.testing.assert_allclose(found.H, expected.H, atol=1e-2 * np.abs(expected.H).max() + 1e-9)
    np.testing.assert_allclose(found.g, expected.g, atol=1e-2 * np.abs(expected.g).max() + 1e-9)


def test_sums_do_not_change_from_run_to_run(surfels: Surfels) -> None:
    problem = PointToPlane(corner(VIEWS[0]), SurfelGrid(surfels))
    first, second = problem.linearised(VIEWS[0]), problem.linearised(VIEWS[0])
    np.testing.assert_array_equal(first.H, second.H)
    assert first.cost == second.cost


def one_wall() -> Surfels:
    """The plane x + 2 y + 3 z = const as surfels, whose residual is linear in the point."""
    random = np.random.default_rng(3)
    n = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    a = np.linalg.svd(n[None])[2][1:]
    points = random.uniform(-1.5, 1.5, (40000, 2)) @ a
    wall = OrientedPoints(
        points.astype(np.float32),
        np.broadcast_to(n, points.shape).astype(np.float32),
        np.zeros(len(points), np.float32),
        np.zeros((len(points), 2), np.int32),
    )
    return surfels_of(wall, np.eye(4), CELL)


@pytest.mark.parametrize("axis", range(6))
def test_the_gradient_is_that_of_finite_differences(axis: int) -> None:
    n = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    T = look_at(1.2 * n + (0.1, 0.0, 0.0), (0, 0, 0))
    problem = PointToPlane(points_of(plane_depth(T[:3, :3].T @ n, 1.2 + 0.03)), SurfelGrid(one_wall()))
    T = moved(T, (0.004, -0.003, 0.006, 0.01, 0.008, -0.012))
    here = problem.linearised(T)
    assert here.matched == here.total
    step, h = np.zeros(6), 2e-3
    step[axis] = h
    ahead, behind = problem.linearised(moved(T, step)), problem.linearised(moved(T, -step))
    numeric = (ahead.cost - behind.cost) / (2 * h)
    assert abs(numeric - here.g[axis]) < 0.02 * np.abs(here.g).max()
    assert np.abs(here.g).max() > 0
