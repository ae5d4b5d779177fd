"""Another camera, other noise, another law of measurements: the same kernels map the right surface."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from spherical_camera import PixelNoise, SphericalCamera, SphericalRays, UniformLaw

from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.errors import MapFileError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.kernels.bundles import kernel
from taichi_mrf.kernels.types import AnyArray
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import PolynomialNoise

ONE_BACKEND = pytest.mark.usefixtures("one_backend")

CAMERA = SphericalCamera(192, 48, 0.8)
VOXEL, SIGMA = 0.1, 0.02
HALF_M = np.array([2.03, 1.52, 1.24])
"""Half the sizes of a room, from wall to wall."""

EYES = ((0.0, 0.1, 0.05), (0.9, -0.4, 0.1), (-0.8, 0.5, -0.2))


def pose(eye: tuple[float, float, float]) -> Pose:
    return look_at(eye, np.add(eye, (1.0, 0.4, 0.0)))


def ranges(T: Pose, camera: SphericalCamera = CAMERA) -> NDArray[np.float32]:
    """What the camera measures of the room's walls, exactly."""
    along = camera.rays() @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        return ((np.copysign(HALF_M, along) - T[:3, 3]) / along).min(axis=-1).astype(np.float32)


def mapped(m: MRFMap | LogOddsMap) -> MRFMap | LogOddsMap:
    for eye in EYES:
        m.add_keyframe(ranges(pose(eye)), pose(eye), CAMERA)
    m.infer()
    return m


def off_the_walls(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of points from the nearest wall."""
    outside = np.maximum(np.abs(points) - HALF_M, 0.0)
    inside = (HALF_M - np.abs(points)).min(axis=1)
    return np.where(inside > 0, inside, np.linalg.norm(outside, axis=1))


def right_share(m: MRFMap | LogOddsMap) -> float:
    """Share of a new view's pixels whose rendered range is within a voxel of the wall."""
    T = pose((0.4, 0.3, -0.1))
    return float(np.mean(np.abs(m.render_depth(CAMERA, T) - ranges(T)) < VOXEL))


def test_it_is_a_camera() -> None:
    assert isinstance(CAMERA, Camera)


@pytest.mark.usefixtures("backend")
def test_a_spherical_camera_maps_the_right_surface() -> None:
    check_surface(mapped(MRFMap(VOXEL, PolynomialNoise((SIGMA,)))))


@kernel
def _directions_and_planes(camera: SphericalRays, normals: AnyArray, out: AnyArray) -> None:
    for pixel in range(out.shape[0]):
        u, v = camera.pixel(pixel)
        here, right, down = (
            camera.direction(u, v),
            camera.direction(u + 0.01, v),
            camera.direction(u, v + 0.01),
        )
        inverse, along_u, along_v = 0.0, 0.0, 0.0
        for axis in range(3):
            out[pixel, axis] = here[axis]
            inverse += here[axis] * normals[pixel, axis]
            along_u += (right[axis] - here[axis]) * 100.0 * normals[pixel, axis]
            along_v += (down[axis] - here[axis]) * 100.0 * normals[pixel, axis]
        n = camera.plane(u, v, along_u, along_v, inverse)
        for axis in range(3):
            out[pixel, 3 + axis] = n[axis]


@pytest.mark.usefixtures("backend")
def test_kernels_and_host_have_the_same_rays_and_planes_are_found_again() -> None:
    normals = np.random.default_rng(0).normal(size=(CAMERA.width * CAMERA.height, 3)).astype(np.float32)
    out = np.zeros((len(normals), 6), np.float32)
    _directions_and_planes(CAMERA.in_kernels(), normals, out)
    np.testing.assert_allclose(out[:, :3], CAMERA.rays().reshape(-1, 3), atol=1e-5)
    np.testing.assert_allclose(out[:, 3:], normals, atol=2e-2)


@ONE_BACKEND
@pytest.mark.parametrize(
    "m",
    [
        lambda: MRFMap(VOXEL, PolynomialNoise((SIGMA,)), return_pass="retrace", ray_density=0.3),
        lambda: MRFMap(VOXEL, PolynomialNoise((SIGMA,)), method="max-product"),
        lambda: MRFMap(VOXEL, PixelNoise(np.full(CAMERA.shape, SIGMA, np.float32), UniformLaw)),
        lambda: LogOddsMap(VOXEL, PolynomialNoise((SIGMA,))),
    ],
    ids=["bundled and retraced", "max-product", "another law", "LogOddsMap"],
)
def test_so_do_other_methods_and_another_law(m: Callable[[], MRFMap | LogOddsMap]) -> None:
    check_surface(mapped(m()))


def check_surface(found: MRFMap | LogOddsMap) -> None:
    centres, _ = found.voxels(0.5)
    assert len(centres) > 1000
    assert np.quantile(off_the_walls(centres), 0.99) < VOXEL
    assert right_share(found) > 0.97
    inside = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 3))
    assert (found.occupancy(inside) < 0.5).all()


@ONE_BACKEND
def test_a_sigma_for_each_pixel_is_that_of_the_polynomial_where_they_are_equal() -> None:
    same = mapped(MRFMap(VOXEL, PixelNoise(np.full(CAMERA.shape, SIGMA, np.float32))))
    polynomial = mapped(MRFMap(VOXEL, PolynomialNoise((SIGMA,))))
    centres, p = polynomial.voxels(0.0)
    np.testing.assert_allclose(same.occupancy(centres), p, atol=2e-3)


@ONE_BACKEND
def test_pixels_with_a_large_sigma_are_trusted_less() -> None:
    sigma = np.full(CAMERA.shape, SIGMA, np.float32)
    sigma[:, : CAMERA.width // 2] = 0.3
    m = MRFMap(VOXEL, PixelNoise(sigma))
    T = pose(EYES[0])
    m.add_keyframe(ranges(T), T, CAMERA)
    m.infer()
    points = (CAMERA.rays() * ranges(T)[..., None]) @ T[:3, :3].T + T[:3, 3]
    p = m.occupancy(points.reshape(-1, 3)).reshape(CAMERA.shape)
    left, right = p[:, 4 : CAMERA.width // 2 - 4], p[:, CAMERA.width // 2 + 4 : -4]
    assert np.median(left) < np.median(right) - 0.2


@ONE_BACKEND
def test_normals_of_an_unrolled_image_are_those_of_the_walls() -> None:
    T, fine = pose(EYES[0]), SphericalCamera(768, 192, 0.8)
    image = DepthImage.upload(ranges(T, fine), fine, PolynomialNoise((SIGMA,)))
    points = oriented_points(image, 10.0)
    world, normals = points.points @ T[:3, :3].T + T[:3, 3], points.normals @ T[:3, :3].T
    assert len(world) > 500
    assert off_the_walls(world).max() < 1e-3
    axis = np.abs(np.abs(world) - HALF_M).argmin(axis=1)
    rows = np.arange(len(world))
    cosine = -np.sign(world[rows, axis]) * normals[rows, axis]
    assert np.median(cosine) > 0.999
    assert np.quantile(cosine, 0.1) > 0.98


@ONE_BACKEND
def test_a_map_with_another_camera_is_not_saved_by_mistake(tmp_path: Path) -> None:
    m = mapped(MRFMap(VOXEL, PolynomialNoise((SIGMA,))))
    with pytest.raises(MapFileError, match="camera of type SphericalCamera cannot be saved"):
        m.save(tmp_path / "map.npz")
    assert not (tmp_path / "map.npz").exists()
