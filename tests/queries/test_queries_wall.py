"""A wall that one picture has seen, asked in every way that a map can be."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import look_at
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.voxels.layout import BRICK

VOXEL = 0.05
BRICK_M = BRICK * VOXEL
CAMERA = PinholeCamera(width=48, height=36, fx=40, fy=42, cx=23.2, cy=17.9)

WALL_AT = 2.055
"""The wall stands in the middle of a layer of voxels, at y = 2.775 m."""

WALL_CAMERA = CAMERA.scaled(2.5)
"""At the wall, some six rays a voxel."""


@pytest.fixture(scope="module")
def wall_map(backend: str) -> MRFMap:
    """One picture of a wall square to the camera; its left third has no measurement."""
    depth = np.full(WALL_CAMERA.shape, WALL_AT, np.float32)
    depth[:, : WALL_CAMERA.width // 3] = 0
    m = MRFMap(VOXEL, PolynomialNoise((0.01,)), surface_density=2.1)
    m.add_keyframe(depth, WALL_POSE, WALL_CAMERA)
    m.infer()
    return m


WALL_POSE = look_at((-3.31, 0.72, 1.13), (-3.31, 5.0, 1.13))
"""Looks along +y."""


def along(pixels: NDArray, depth: float) -> NDArray[np.float64]:
    """World points on rays (n, 2 pixels: u, v) at an axial depth."""
    local = WALL_CAMERA.rays()[pixels[:, 1], pixels[:, 0]] * depth
    return local @ WALL_POSE[:3, :3].T + WALL_POSE[:3, 3]


SEEN = np.stack(np.meshgrid(np.arange(50, 110), np.arange(10, 80)), axis=-1).reshape(-1, 2)
UNSEEN = np.stack(np.meshgrid(np.arange(0, 30), np.arange(10, 80)), axis=-1).reshape(-1, 2)


def test_a_walls_map_is_free_before_occupied_at_and_unknown_behind(wall_map: MRFMap) -> None:
    prior = -np.expm1(-2.1 * VOXEL)
    assert wall_map.prior == pytest.approx(prior)
    for depth in (0.4, 1.0, 1.5, 1.9):
        before = along(SEEN, depth)
        assert (wall_map.occupancy(before) < 0.5 * prior).all()
        assert (wall_map.state(before) == FREE).all()
    at_wall = along(SEEN, WALL_AT)
    assert (wall_map.state(at_wall) == OCCUPIED).mean() > 0.99
    for nobody in (along(SEEN, 3.0), along(UNSEEN, 1.0), along(UNSEEN, WALL_AT), -along(SEEN, 1.0)):
        np.testing.assert_allclose(wall_map.occupancy(nobody), prior, atol=1e-6)
        assert (wall_map.state(nobody) == UNKNOWN).all()


def test_a_walls_voxels_lie_at_the_wall(wall_map: MRFMap) -> None:
    centres, found = wall_map.voxels(min_probability=0.5)
    assert len(centres) > 500
    assert (found >= 0.5).all()
    assert (np.abs(centres[:, 1] - (WALL_POSE[1, 3] + WALL_AT)) < 1.01 * VOXEL).all()
    np.testing.assert_allclose(wall_map.occupancy(centres), found, rtol=1e-6)
    assert len(wall_map.voxels(0.0)[0]) == wall_map.statistics().voxels


def test_a_wall_is_rendered_where_it_stands_and_only_where_it_was_seen(wall_map: MRFMap) -> None:
    depth = wall_map.render_depth(WALL_CAMERA, WALL_POSE)
    seen = depth[10:80, 50:110]
    assert np.isfinite(seen).all()
    assert np.abs(seen - WALL_AT).max() <= 0.5 * VOXEL
    # Bricks at the edge of what was seen hold voxels at the prior, half a metre of which stops a ray.
    brick_in_pixels = BRICK_M / WALL_AT * WALL_CAMERA.fx
    edge = WALL_CAMERA.width // 3 - int(1.2 * brick_in_pixels)
    assert edge > 10
    assert np.isnan(depth[:, :edge]).all()
    nearer = look_at((-3.0, 1.4, 1.2), (-3.0, 5.0, 1.2))
    from_there = wall_map.render_depth(WALL_CAMERA, nearer)[25:65, 45:75]
    assert np.abs(from_there - (WALL_POSE[1, 3] + WALL_AT - 1.4)).max() <= 0.5 * VOXEL


def test_a_wall_in_a_profile(wall_map: MRFMap) -> None:
    direction = along(SEEN[2000:2001], 1.0)[0] - WALL_POSE[:3, 3]
    profile = wall_map.ray_profile(WALL_POSE[:3, 3], direction)
    per_depth = np.linalg.norm(direction)
    assert abs(profile.distance[profile.omega.argmax()] / per_depth - WALL_AT) <= 0.5 * VOXEL
    before = profile.distance < (WALL_AT - 2 * VOXEL) * per_depth
    assert (profile.visibility[before] > 0.95).all()
    assert (np.diff(profile.visibility) <= 0).all()
    assert profile.visibility[-1] < 0.2
