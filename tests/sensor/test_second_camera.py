"""Another camera, other noise, another law of measurements: the same kernels map the right surface."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from plugged_noise import PixelNoise, UniformLaw

from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera

MapT = TypeVar("MapT", MRFMap, LogOddsMap)
ONE_BACKEND = pytest.mark.usefixtures("one_backend")


def lidar(columns: int, rows: int) -> SphericalCamera:
    """All azimuths, and elevations up to 0.8 radians; neighbouring rows are staggered by half a column."""
    azimuths = np.linspace(np.pi, -np.pi, columns, endpoint=False)
    offsets = np.tile([0.0, -np.pi / columns], rows)[:rows]
    return SphericalCamera(np.linspace(0.8, -0.8, rows), azimuths, offsets)


CAMERA = lidar(192, 48)
VOXEL, SIGMA = 0.1, 0.02
HALF_M = np.array([2.03, 1.52, 1.24])
"""Half the sizes of a room, from wall to wall."""

EYES = ((0.0, 0.1, 0.05), (0.9, -0.4, 0.1), (-0.8, 0.5, -0.2))


def pose(eye: tuple[float, float, float], camera: Camera = CAMERA) -> Pose:
    """Level, and turned a little against the walls."""
    T = look_at(eye, np.add(eye, (1.0, 0.4, 0.0)))
    if camera.up == (0.0, 0.0, 1.0):
        T[:3, :3] = np.stack([T[:3, 2], -T[:3, 0], -T[:3, 1]], axis=1)
    return T


def ranges(T: Pose, camera: Camera = CAMERA) -> NDArray[np.float32]:
    """Exact depth of the room's walls at the camera."""
    along = camera.rays() @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        return ((np.copysign(HALF_M, along) - T[:3, 3]) / along).min(axis=-1).astype(np.float32)


def mapped(m: MapT, camera: Camera = CAMERA) -> MapT:
    for eye in EYES:
        T = pose(eye, camera)
        m.add_keyframe(ranges(T, camera), T, camera)
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


@pytest.mark.usefixtures("backend")
def test_a_spherical_camera_maps_the_right_surface() -> None:
    check_surface(mapped(MRFMap(VOXEL, PolynomialNoise((SIGMA,)))))


@ONE_BACKEND
def test_the_same_rays_as_a_table_make_the_same_map_bit_for_bit() -> None:
    beliefs = []
    for camera in (CAMERA, RayTable(CAMERA.rays())):
        m = mapped(MRFMap(VOXEL, PolynomialNoise((SIGMA,)), ray_density=0.3), camera)
        beliefs.append(m.voxels(0.0))
        m.refine_pose(1)
        m.infer()
        beliefs.append(m.voxels(0.0))
    for one, other in zip(beliefs[:2], beliefs[2:], strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


@ONE_BACKEND
def test_a_pinhole_as_a_table_makes_the_same_map_but_for_rounding() -> None:
    """Directions are exact in float32 here, so bundles and footprints are the same. The cameras bound the
    pixels of a cone differently, so averages are kept in other steps. Sweeps from no messages enlarge that
    rounding: then the maps are compared as those of two devices are."""
    pinhole = PinholeCamera(96, 64, 64.0, 64.0, 47.5, 31.5)
    cameras = pinhole, RayTable(pinhole.rays())
    T = pose((0.4, 0.3, -0.1), pinhole)
    maps = [MRFMap(VOXEL, PolynomialNoise((SIGMA,)), ray_density=0.3) for _ in cameras]
    for m, camera in zip(maps, cameras, strict=True):
        for eye in EYES:
            at = pose(eye, camera)
            m.add_keyframe(ranges(at, camera), at, camera)
    (centres, p), (again, q) = (m.voxels(0.0) for m in maps)
    np.testing.assert_array_equal(centres, again)
    np.testing.assert_allclose(q, p, atol=2e-5)
    rendered = [m.render_depth(camera, T) for m, camera in zip(maps, cameras, strict=True)]
    np.testing.assert_allclose(rendered[1], rendered[0], atol=1e-4)
    for m in maps:
        m.infer()
    p, q = (m.voxels(0.0)[1] for m in maps)
    assert np.mean(np.abs(q - p) < 0.02) > 0.999


@ONE_BACKEND
@pytest.mark.parametrize(
    "m",
    [
        lambda: MRFMap(VOXEL, PolynomialNoise((SIGMA,)), ray_density=0.3),
        lambda: MRFMap(VOXEL, PixelNoise(np.full(CAMERA.shape, SIGMA, np.float32), UniformLaw)),
        lambda: LogOddsMap(VOXEL, PolynomialNoise((SIGMA,))),
    ],
    ids=["bundled", "another law", "LogOddsMap"],
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


def free(rays: int) -> RayTable:
    """Rays without a pattern, up to 0.7 radians above and below the level."""
    points = np.random.default_rng(0).normal(size=(3 * rays, 3))
    level = np.abs(points[:, 2]) < 0.65 * np.linalg.norm(points, axis=1)
    return RayTable.of_points(points[level][:rays])[0]


@ONE_BACKEND
@pytest.mark.parametrize("fine", [lidar(768, 192), free(60_000)], ids=["lidar", "free rays"])
def test_normals_are_those_of_the_walls(fine: RayTable) -> None:
    T = pose(EYES[0])
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
def test_the_table_of_free_rays_counts_as_part_of_its_image() -> None:
    for camera, bytes_per_pixel in ((CAMERA, 4), (free(500), 16)):
        range_m = np.ones(camera.shape, np.float32)
        image = DepthImage.upload(range_m, camera, PolynomialNoise((SIGMA,)))
        assert image.nbytes == bytes_per_pixel * range_m.size


@ONE_BACKEND
@pytest.mark.parametrize("camera", [lidar(512, 96), free(30_000)], ids=["lidar", "free rays"])
def test_a_misplaced_keyframe_is_put_right(camera: RayTable) -> None:
    m = mapped(MRFMap(VOXEL, PolynomialNoise((SIGMA,))), camera)
    true = pose((0.4, 0.3, -0.1))
    wrong = true.copy()
    wrong[:3, 3] += (0.08, -0.05, 0.04)
    id = m.add_keyframe(ranges(true, camera), wrong, camera)
    m.infer()
    refined = m.refine_pose(id)
    assert refined.accepted
    assert refined.directions == 6
    np.testing.assert_allclose(refined.T_world_camera, true, atol=0.01)
