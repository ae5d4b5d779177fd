"""Maps of scans whose columns have poses of their own: kernels start each ray where the sensor was."""

from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest
from moving_lidar import Knowledge, lidar, mapped, motion, scan, score
from numpy.typing import NDArray

from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import LogOddsConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.queries.contradiction import ray_scores
from taichi_mrf.queries.gain import pixel_gain, view_gain
from taichi_mrf.queries.points import FREE
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.ray_table import RayTable

pytestmark = pytest.mark.usefixtures("one_backend")

VOXEL, NOISE = 0.125, PolynomialNoise((0.02,))
HALF_M = np.array([2.03, 1.52, 1.24])
"""Half the sizes of a room, from wall to wall."""

STILL = lidar(24, 96)
SENSOR = SensorConfig(sigma=(0.02,), max_depth=8.0, no_return="free", no_return_depth=1.5)
LOST = np.random.default_rng(0).random(STILL.shape) < 0.1
"""Pixels without a return."""

MAPS: dict[str, Callable[[], Any]] = {
    "mrf": lambda: MRFMap.from_config(Config(voxel_size=VOXEL, sensor=SENSOR), STILL),
    "log-odds": lambda: LogOddsMap.from_config(
        Config(voxel_size=VOXEL, sensor=SENSOR, log_odds=LogOddsConfig(max_range=2.5)), STILL
    ),
    "log-odds, discretised": lambda: LogOddsMap(VOXEL, NOISE, discretise=True),
    "visibility": lambda: VisibilityMap(VOXEL, NOISE),
}


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


EYES = (pose(0.0, 0.1, 0.05, 0.3), pose(0.6, -0.4, 0.1, 1.4))


def ranges(camera: Camera, T: Pose) -> NDArray[np.float32]:
    """Exact depth of the room's walls at a camera."""
    along = camera.rays() @ T[:3, :3].T
    starts = points_at(camera, np.zeros(camera.shape)) @ T[:3, :3].T + T[:3, 3]
    with np.errstate(divide="ignore"):
        return ((np.copysign(HALF_M, along) - starts) / along).min(axis=-1).astype(np.float32)


def off_the_walls(points: NDArray) -> NDArray[np.float64]:
    inside = (HALF_M - np.abs(points)).min(axis=1)
    return np.where(inside > 0, inside, np.linalg.norm(np.maximum(np.abs(points) - HALF_M, 0.0), axis=1))


def test_columns_that_all_stand_still_make_the_same_map_bit_for_bit() -> None:
    moving = RayTable.moving(STILL, np.tile(np.eye(4), (STILL.width, 1, 1)))
    maps = []
    for camera in (STILL, moving):
        m = MRFMap(VOXEL, NOISE, ray_density=0.3)
        for T in EYES:
            m.add_keyframe(ranges(STILL, T), T, camera)
        m.infer()
        maps.append(m.voxels(0.0))
    np.testing.assert_array_equal(maps[0][0], maps[1][0])
    np.testing.assert_array_equal(maps[0][1], maps[1][1])


@pytest.mark.parametrize("make", MAPS.values(), ids=MAPS)
def test_columns_that_are_all_moved_alike_make_the_map_of_the_moved_sensor(make: Callable[[], Any]) -> None:
    """By eighths of metres, which float32 holds exactly. Kernels with and without origins are compiled to
    other roundings."""
    step = pose(8.375, -6.25, 0.125)  # further than the room is large
    moving = RayTable.moving(STILL, np.tile(step, (STILL.width, 1, 1)))
    one, other = make(), make()
    for eye in ((-8.375, 6.375, -0.125), (-7.875, 5.875, 0.125)):
        T = pose(*eye)
        measured = np.where(LOST, np.float32(0.0), ranges(STILL, T @ step))
        one.add_keyframe(measured, T, moving, no_return=LOST)
        other.add_keyframe(measured, T @ step, STILL, no_return=LOST)
    for m in (one, other):
        m.infer()
    (centres, p), (expected, q) = one.voxels(0.0), other.voxels(0.0)
    np.testing.assert_array_equal(centres, expected)
    assert np.mean(np.abs(p - q) > 1e-4) < 1e-3, "only voxels that rays graze"
    T = pose(-8.0, 6.5, 0.0)
    rendered, again = one.render_depth(moving, T), other.render_depth(STILL, T @ step)
    assert np.isfinite(rendered).mean() > 0.5
    np.testing.assert_allclose(rendered, again, atol=1e-3)
    np.testing.assert_allclose(
        pixel_gain(one, moving, T, 4.0), pixel_gain(other, STILL, T @ step, 4.0), atol=1e-3
    )


@pytest.mark.parametrize("make", MAPS.values(), ids=MAPS)
@pytest.mark.parametrize("directions", [[[0, 0, 1.0]], [[1.0, 0, 0], [0, 1.0, 0]]], ids=["line", "plane"])
def test_rays_in_one_line_or_plane_along_the_axes_are_mapped(
    make: Callable[[], Any], directions: list[list[float]]
) -> None:
    sensor, m = RayTable(directions), make()
    m.add_keyframe(np.full(sensor.shape, 1.0, np.float32), np.eye(4), sensor)
    m.infer()
    assert (m.state(0.5 * np.array(directions)) == FREE).all()


@pytest.mark.parametrize("make", MAPS.values(), ids=MAPS)
def test_walls_seen_in_motion_are_where_they_are(make: Callable[[], Any]) -> None:
    m = make()
    moving = RayTable.moving(STILL, motion(STILL.width))
    for T in EYES:
        m.add_keyframe(ranges(moving, T), T, moving)
    m.infer()
    centres, _ = m.voxels(0.5)
    assert len(centres) > 800
    assert np.median(off_the_walls(centres)) < 0.7 * VOXEL
    assert np.quantile(off_the_walls(centres), 0.99) < 2 * VOXEL
    inside = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 3))
    assert (m.occupancy(inside) <= 0.5).all()


def test_what_a_moving_sensor_would_see_is_asked_along_its_rays() -> None:
    """Rendering, contradictions and gains of a scan that the map does not hold, and the surface."""
    still = lidar(64, 256)
    moving = RayTable.moving(still, motion(256))
    m = MRFMap(VOXEL, NOISE)
    for T in EYES:
        m.add_keyframe(ranges(moving, T), T, moving)
    m.infer()
    new = pose(-0.5, 0.4, -0.1, 0.8)
    expected = ranges(moving, new)
    assert np.mean(np.abs(m.render_depth(moving, new) - expected) < VOXEL) > 0.92
    assert np.mean(np.abs(m.render_depth(still, new) - expected) < VOXEL) < 0.8
    assert np.nanmean(np.abs(ray_scores(m, expected, new, moving)) > 3.0) < 0.02
    assert np.nanmean(np.abs(ray_scores(m, expected, new, still)) > 3.0) > 0.1
    assert 0.0 < float(view_gain(m, moving, new, 4.0)) < 1e4
    off = off_the_walls(m.surface().vertices_m)
    assert len(off) > 1000
    assert np.median(off) < 0.01


@pytest.mark.parametrize("free", [False, True], ids=["columns", "free rays"])
def test_normals_seen_in_motion_are_those_of_the_walls(free: bool) -> None:
    """With the rays taken for those of one centre, a tenth of the normals is off by 10 degrees."""
    T, fine, poses = EYES[0], lidar(192, 768), motion(768, 2.0)
    camera = RayTable.moving(fine, poses)
    if free:
        points = (fine.rays() * ranges(camera, T)[..., None]).reshape(-1, 3)
        camera, _ = RayTable.of_points(points, np.tile(poses, (192, 1, 1)))
    image = DepthImage.upload(ranges(camera, T), camera, NOISE)
    found = oriented_points(image, 10.0)
    world, normals = found.points @ T[:3, :3].T + T[:3, 3], found.normals @ T[:3, :3].T
    assert len(world) > 500
    assert off_the_walls(world).max() < 1e-5
    axis = np.abs(np.abs(world) - HALF_M).argmin(axis=1)
    rows = np.arange(len(world))
    cosine = -np.sign(world[rows, axis]) * normals[rows, axis]
    assert np.quantile(cosine, 0.1) > 0.9999


def test_a_misplaced_scan_in_motion_is_put_right() -> None:
    moving = RayTable.moving(lidar(96, 512), motion(512))
    m = MRFMap(0.1, NOISE)
    for T in EYES:
        m.add_keyframe(ranges(moving, T), T, moving)
    true = pose(0.3, 0.2, -0.1, 0.7)
    wrong = true.copy()
    wrong[:3, 3] += (0.06, -0.05, 0.04)
    id = m.add_keyframe(ranges(moving, true), wrong, moving)
    m.infer()
    refined = m.refine_pose(id)
    assert refined.accepted
    np.testing.assert_allclose(refined.T_world_camera, true, atol=0.01)


@pytest.mark.soak
def test_poses_of_columns_make_a_better_map_than_points_moved_to_one_centre() -> None:
    scans = [scan(number, 2, lidar(48, 512), 1.0) for number in range(2)]
    found = {known: score(mapped(scans, known, 0.05), 1) for known in get_args(Knowledge)}
    assert found["columns"].right > found["points"].right > found["nothing"].right + 0.3
    assert found["columns"].wrongly_free < 0.5 * found["points"].wrongly_free
