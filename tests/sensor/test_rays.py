"""Which way rays go in kernels: those of the camera on the host, and the planes that pixels see."""

import numpy as np
import pytest
import taichi as ti

from taichi_mrf.kernels.bundles import kernel
from taichi_mrf.kernels.types import AnyArray, F32Array2, F32Array3
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.rays import CameraRays

pytestmark = pytest.mark.usefixtures("backend")

CAMERA = PinholeCamera(13, 9, 20.0, 17.0, 5.3, 4.9)


@kernel
def _directions(camera: CameraRays, out: F32Array3) -> None:
    for pixel in range(out.shape[0] * camera.width):
        u, v = camera.pixel(pixel)
        d = camera.direction(u, v)
        for axis in ti.static(range(3)):
            out[v, u, axis] = d[axis]


@kernel
def _planes(camera: CameraRays, slopes: AnyArray, out: F32Array2) -> None:
    """Each row of ``slopes`` is u, v, the inverse depth's derivatives by u and v, and the inverse depth."""
    for i in range(out.shape[0]):
        n = camera.plane(slopes[i, 0], slopes[i, 1], slopes[i, 2], slopes[i, 3], slopes[i, 4])
        for axis in ti.static(range(3)):
            out[i, axis] = n[axis]


def test_directions_are_the_cameras() -> None:
    out = np.zeros((9, 13, 3), np.float32)
    _directions(CAMERA.in_kernels(), out)
    np.testing.assert_allclose(out, CAMERA.rays(), atol=1e-6)


def test_planes_have_the_inverse_depth_that_they_are_made_of() -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    u, v = rng.integers(0, 13, 50), rng.integers(0, 9, 50)
    inverse = [
        (normals * CAMERA.directions(u + du, v + dv)).sum(axis=1) for du, dv in ((0, 0), (1, 0), (0, 1))
    ]
    slopes = np.stack([u, v, inverse[1] - inverse[0], inverse[2] - inverse[0], inverse[0]], axis=1)
    out = np.zeros((50, 3), np.float32)
    _planes(CAMERA.in_kernels(), slopes.astype(np.float32), out)
    np.testing.assert_allclose(out, normals, atol=1e-4)


def test_a_tiles_hull_holds_its_rays() -> None:
    hulls = CAMERA.tile_hulls(4)
    assert hulls.shape == (3, 4, 4, 3)
    for row in range(3):
        for column in range(4):
            rays = CAMERA.rays()[row * 4 : row * 4 + 4, column * 4 : column * 4 + 4].reshape(-1, 3)
            assert (rays >= hulls[row, column].min(axis=0)).all()
            assert (rays <= hulls[row, column].max(axis=0)).all()
