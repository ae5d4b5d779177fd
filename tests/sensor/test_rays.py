"""Which way rays go in kernels: those of the camera on the host, and the planes that pixels see."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.rays import CameraRays
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import AnyArray, F32Array2, F32Array3

pytestmark = pytest.mark.usefixtures("backend")

CAMERA = PinholeCamera(13, 9, 20.0, 17.0, 5.3, 4.9)
LIDAR = SphericalCamera(
    np.linspace(0.6, -0.5, 9), np.linspace(3.0, -3.0, 13) / 4, np.tile([0.0, 0.05], 5)[:9]
)
CAMERAS = pytest.mark.parametrize(
    "camera", [CAMERA, RayTable(CAMERA.rays()), LIDAR], ids=["pinhole", "pinhole as a table", "lidar"]
)


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


@CAMERAS
def test_directions_are_the_cameras(camera: Camera) -> None:
    out = np.zeros((9, 13, 3), np.float32)
    _directions(camera.in_kernels(), out)
    np.testing.assert_allclose(out, camera.rays(), atol=1e-6)


@kernel
def _between(camera: CameraRays, places: F32Array2, out: F32Array2) -> None:
    for i in range(out.shape[0]):
        d = camera.direction(places[i, 0], places[i, 1])
        for axis in ti.static(range(3)):
            out[i, axis] = d[axis]


@CAMERAS
def test_directions_between_pixels_are_the_cameras_too(camera: Camera) -> None:
    places = np.random.default_rng(0).uniform((0, 0), (12, 8), (60, 2)).astype(np.float32)
    out = np.zeros((60, 3), np.float32)
    _between(camera.in_kernels(), places, out)
    np.testing.assert_allclose(out, camera.directions(*places.T), atol=1e-6)


def test_between_pixels_a_lidars_rays_have_the_length_1_and_lie_in_the_middle() -> None:
    middle = LIDAR.directions(np.arange(12) + 0.5, 4.0)
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 1.0, atol=1e-12)
    row = LIDAR.rays()[4]
    np.testing.assert_allclose((middle * row[:-1]).sum(axis=1), (middle * row[1:]).sum(axis=1), atol=1e-6)


@CAMERAS
def test_planes_have_the_inverse_depth_that_they_are_made_of(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    u, v = rng.integers(1, 12, 50), rng.integers(1, 8, 50)

    def inverse(du: float, dv: float) -> NDArray[np.float64]:
        return (normals * camera.directions(u + du, v + dv)).sum(axis=1)

    along_u, along_v = inverse(0.5, 0) - inverse(-0.5, 0), inverse(0, 0.5) - inverse(0, -0.5)
    slopes = np.stack([u, v, along_u, along_v, inverse(0, 0)], axis=1)
    out = np.zeros((50, 3), np.float32)
    _planes(camera.in_kernels(), slopes.astype(np.float32), out)
    np.testing.assert_allclose(out, normals, atol=1e-4)


@kernel
def _starts(camera: CameraRays, places: F32Array2, out: F32Array2) -> None:
    for i in range(out.shape[0]):
        start = camera.origin(places[i, 0], places[i, 1])
        for axis in ti.static(range(3)):
            out[i, axis] = start[axis]


ORIGINS_M = np.random.default_rng(5).normal(size=(9, 13, 3)).cumsum(axis=1) * 0.0005
MOVING = pytest.mark.parametrize(
    "camera",
    [RayTable(LIDAR.rays(), ORIGINS_M[0]), RayTable(LIDAR.rays(), ORIGINS_M)],
    ids=["columns", "pixels"],
)


@MOVING
def test_rays_of_a_moving_camera_start_where_it_says(camera: RayTable) -> None:
    places = np.random.default_rng(0).uniform((0, 0), (12, 8), (60, 2)).astype(np.float32)
    places[:30] = places[:30].round()
    out = np.zeros((60, 3), np.float32)
    _starts(camera.in_kernels(), places, out)
    np.testing.assert_allclose(out, camera.origins(*places.T), atol=1e-6)


@MOVING
def test_planes_of_a_moving_camera_are_seen_from_the_pixels_origin(camera: RayTable) -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    u, v = rng.integers(1, 12, 50), rng.integers(1, 8, 50)

    def inverse(du: float, dv: float) -> NDArray[np.float64]:
        """n . (o + d / inverse) = 1, where o is the way from the pixel's origin."""
        way = camera.origins(u + du, v + dv) - camera.origins(u, v)
        return (normals * camera.directions(u + du, v + dv)).sum(axis=1) / (1 - (normals * way).sum(axis=1))

    along_u, along_v = inverse(0.5, 0) - inverse(-0.5, 0), inverse(0, 0.5) - inverse(0, -0.5)
    slopes = np.stack([u, v, along_u, along_v, inverse(0, 0)], axis=1)
    out = np.zeros((50, 3), np.float32)
    _planes(camera.in_kernels(), slopes.astype(np.float32), out)
    np.testing.assert_allclose(out, normals, atol=6e-3)
    _planes(LIDAR.in_kernels(), slopes.astype(np.float32), out)
    assert np.abs(out - normals).max() > 1.8e-2


def test_where_directions_do_not_change_a_plane_faces_its_ray() -> None:
    camera = RayTable(np.broadcast_to([0.6, 0.0, 0.8], (2, 3, 3)))
    out = np.zeros((1, 3), np.float32)
    _planes(camera.in_kernels(), np.array([[1, 1, 0.3, 0.2, 0.5]], np.float32), out)
    np.testing.assert_allclose(out[0], [0.3, 0.0, 0.4], atol=1e-6)


def test_a_tiles_hull_holds_its_rays() -> None:
    hulls = CAMERA.tile_hulls(4)
    assert hulls.shape == (3, 4, 4, 3)
    for row in range(3):
        for column in range(4):
            rays = CAMERA.rays()[row * 4 : row * 4 + 4, column * 4 : column * 4 + 4].reshape(-1, 3)
            assert (rays >= hulls[row, column].min(axis=0)).all()
            assert (rays <= hulls[row, column].max(axis=0)).all()
