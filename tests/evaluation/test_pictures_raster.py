"""The voxel raster against a brute-force slab test of every ray with every voxel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.raster import cast_voxels
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(width=37, height=29, fx=30.0, fy=26.0, cx=17.2, cy=15.1)


def _entries(
    centres: NDArray[np.float64], voxel_size: float, T_world_camera: Pose
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depth of entry (H, W, N), infinite for a miss, and the length (in depth) of the crossing or,
    negative, of the miss."""
    R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
    directions = CAMERA.rays() @ R.T
    with np.errstate(divide="ignore"):
        a = (centres - voxel_size / 2 - eye) / directions[:, :, None]
        b = (centres + voxel_size / 2 - eye) / directions[:, :, None]
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    corners = centres[:, None] + voxel_size * (np.array(list(np.ndindex(2, 2, 2))) - 0.5)
    in_front = ((corners - eye) @ R[:, 2]).min(axis=1) > voxel_size / 2
    return np.where((enter <= leave) & in_front, enter, np.inf), np.where(in_front, leave - enter, -np.inf)


def _check(centres: NDArray[np.float64], voxel_size: float, pose: Pose) -> int:
    """Compare all pixels except those whose ray grazes an edge; returns how many hit a voxel."""
    image = cast_voxels(centres, voxel_size, CAMERA, pose)
    enter, crossing = _entries(centres, voxel_size * (1 + 1e-5), pose)
    clear = (np.abs(crossing) > 1e-4).all(axis=-1)
    hit = np.isfinite(enter).any(axis=-1)
    assert clear.mean() > 0.9
    np.testing.assert_array_equal((image.index >= 0)[clear], hit[clear])
    np.testing.assert_array_equal(np.isfinite(image.depth_m), image.index >= 0)
    both = clear & hit
    # In float32 depth is a difference of quotients by the direction: a ray along a face meets it inexactly.
    tolerance = 1e-6 * (1 + 1 / np.abs(CAMERA.rays() @ pose[:3, :3].T).min(axis=-1))
    nearest = enter.min(axis=-1)
    chosen = np.take_along_axis(enter, np.maximum(image.index, 0)[..., None], -1)[..., 0]
    assert (np.abs(image.depth_m[both] - nearest[both]) <= tolerance[both]).all()
    assert (np.abs(chosen[both] - nearest[both]) <= tolerance[both]).all()
    return int(both.sum())


@given(seed=st.integers(0, 2**32 - 1), voxel_size=st.sampled_from([0.02, 0.1, 0.3]))
@settings(max_examples=40, deadline=None)
def test_first_hits_are_exact(seed: int, voxel_size: float) -> None:
    """Also with voxels beside, behind and around the camera."""
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(-6, 7, (150, 3)), axis=0)
    centres = (cells + 0.5) * voxel_size
    eye, target = rng.uniform(-9, 9, (2, 3)) * voxel_size
    _check(centres, voxel_size, look_at(eye, target, rng.normal(size=3)))


def test_hidden_voxels() -> None:
    """Several layers, most voxels of which are behind others."""
    cells = np.array([(i, j, 4 * k) for k in range(4) for i in range(-12, 13) for j in range(-12, 13)])
    centres = (cells + 0.5) * 0.1
    pose = look_at((0.3, 0.2, -1.0), (0.1, 0.0, 1.0), (0.0, -1.0, 0.1))
    assert _check(centres, 0.1, pose) > 0.8 * CAMERA.width * CAMERA.height


def test_axis_parallel_rays_and_face_normals() -> None:
    camera = PinholeCamera(width=3, height=3, fx=10.0, fy=10.0, cx=1.0, cy=1.0)
    pose = look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    image = cast_voxels(np.zeros((1, 3)), 1.0, camera, pose)
    np.testing.assert_allclose(image.depth_m, 1.5, atol=1e-5)
    np.testing.assert_array_equal(image.normal, np.broadcast_to([0.0, 0.0, 1.0], (3, 3, 3)))


def test_no_cracks_along_common_faces() -> None:
    """A wall of voxels seen squarely from afar, with rays exactly along the faces between them."""
    cells = np.array([(i, j, 0) for i in range(-20, 20) for j in range(-20, 20)])
    camera = PinholeCamera(width=101, height=101, fx=1e5, fy=1e5, cx=50.0, cy=50.0)
    pose = look_at((0.0, 0.0, 1000.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    assert (cast_voxels((cells + 0.5) * 0.05, 0.05, camera, pose).index >= 0).all()


def test_nothing_to_see() -> None:
    for centres in (np.zeros((0, 3)), np.array([[0.0, 0.0, -3.0]])):
        image = cast_voxels(centres, 0.1, CAMERA, np.eye(4))
        assert np.isnan(image.depth_m).all()
        assert (image.index == -1).all()
        assert (image.normal == 0).all()


def test_far_from_the_origin() -> None:
    """Coordinates are taken relative to the camera before they are rounded to float32."""
    shift = np.array([5e4, -3e4, 2e4])
    rng = np.random.default_rng(3)
    centres = (np.unique(rng.integers(-6, 7, (150, 3)), axis=0) + 0.5) * 0.1
    pose = look_at((1.5, 1.1, 0.7), (0.0, 0.0, 0.0))
    moved = pose.copy()
    moved[:3, 3] += shift
    here, there = cast_voxels(centres, 0.1, CAMERA, pose), cast_voxels(centres + shift, 0.1, CAMERA, moved)
    np.testing.assert_allclose(there.depth_m, here.depth_m, atol=1e-4)
