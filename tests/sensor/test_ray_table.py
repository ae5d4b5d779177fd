"""Spherical cameras and tables of rays on the host: shapes, equality, hulls, counts, refused arguments."""

import pickle
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.up import up_of
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera

ELEVATIONS = np.deg2rad(np.linspace(45.0, -45.0, 24))
AZIMUTHS = np.deg2rad(np.linspace(180.0, -180.0, 90, endpoint=False))
OFFSETS = np.deg2rad(np.tile([1.5, -1.5], 12))
LIDAR = SphericalCamera(ELEVATIONS, AZIMUTHS, OFFSETS)
PINHOLE = PinholeCamera(40, 30, 35.0, 32.0, 20.0, 14.0)


def random_units(n: int, seed: int = 0) -> NDArray[np.float64]:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_beams_have_the_angles_of_their_row_and_column() -> None:
    rays = LIDAR.rays()
    assert LIDAR.shape == rays.shape[:2] == (24, 90)
    np.testing.assert_allclose(np.arcsin(rays[..., 2]), np.tile(ELEVATIONS[:, None], 90), atol=1e-6)
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    wrong = azimuth - (AZIMUTHS + OFFSETS[:, None])
    np.testing.assert_allclose(np.sin(wrong / 2), 0.0, atol=1e-6)
    assert LIDAR.measures_range
    ahead = SphericalCamera([0.0], [0.0, np.pi / 2])
    np.testing.assert_allclose(ahead.rays()[0], [[1, 0, 0], [0, 1, 0]], atol=1e-7)  # x forward, y left


@pytest.mark.parametrize("camera", [LIDAR, RayTable(random_units(7)), PINHOLE])
def test_they_are_cameras(camera: Any) -> None:
    assert isinstance(camera, Camera)
    again = pickle.loads(pickle.dumps(camera))
    assert again == camera
    assert type(again) is type(camera)


def test_tables_with_the_same_rays_are_equal() -> None:
    same = RayTable(LIDAR.rays())
    assert same == LIDAR == SphericalCamera(ELEVATIONS, AZIMUTHS, OFFSETS)
    assert hash(same) == hash(LIDAR)
    assert repr(same) == repr(LIDAR)
    assert SphericalCamera(ELEVATIONS, AZIMUTHS) != LIDAR
    units = random_units(10)
    assert RayTable(units) != RayTable(units[None])  # without a pattern, and with one
    with pytest.raises(ValueError, match="read-only"):
        LIDAR.table[0, 0, 0] = 1.0


def test_a_pinhole_as_a_table_has_the_pinholes_pixels() -> None:
    table = RayTable(PINHOLE.rays())
    assert not table.measures_range
    assert table.pixels_per_radian == pytest.approx(PINHOLE.pixels_per_radian, rel=1e-5)
    hulls = table.tile_hulls(16)
    for side in (np.min, np.max):
        np.testing.assert_allclose(side(hulls, axis=2), side(PINHOLE.tile_hulls(16), axis=2), atol=1e-6)
    np.testing.assert_allclose(table.directions(3.25, 7.5), PINHOLE.directions(3.25, 7.5), atol=1e-6)


@pytest.mark.parametrize("camera", [LIDAR, PINHOLE, RayTable(PINHOLE.rays()), RayTable(random_units(400))])
def test_points_on_rays_are_projected_to_their_pixels(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    u, v = rng.integers(0, camera.width, 20), rng.integers(0, camera.height, 20)
    depth = rng.uniform(0.5, 9.0, 20)
    found = camera.project(camera.directions(u, v) * depth[:, None])
    np.testing.assert_allclose(found, np.stack([u, v, depth], axis=1), atol=1e-4)


def test_points_beside_all_rays_are_seen_by_no_pixel() -> None:
    assert np.isnan(LIDAR.project(np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]))).all()
    assert not np.isnan(LIDAR.project(np.array([[-3.0, 0.01, 0.1]]))).any()
    assert np.isnan(PINHOLE.project(np.array([[0.0, 0.0, -1.0], [3.0, 0.0, 1.0]]))).all()
    assert np.isnan(RayTable([[1.0, 0.0, 0.0]] * 2000).project(np.array([[1.0, 0.3, 0.0]]))).all()


@pytest.mark.parametrize("camera", [LIDAR, PINHOLE, RayTable(random_units(100))])
def test_a_thinned_camera_has_every_third_pixel(camera: Camera) -> None:
    thin = camera.thinned(3)
    np.testing.assert_allclose(thin.rays(), camera.rays()[::3, ::3], atol=1e-6)
    assert thin.shape == thin.rays().shape[:2]


@pytest.mark.parametrize("camera", [LIDAR, RayTable(random_units(100))])
def test_a_tiles_hull_holds_its_rays(camera: RayTable) -> None:
    hulls = camera.tile_hulls(16)
    assert hulls.shape[:2] == (-(-camera.height // 16), -(-camera.width // 16))
    for row, column in np.ndindex(hulls.shape[:2]):
        rays = camera.rays()[row * 16 : row * 16 + 16, column * 16 : column * 16 + 16].reshape(-1, 3)
        assert (rays >= hulls[row, column].min(axis=0)).all()
        assert (rays <= hulls[row, column].max(axis=0)).all()


@pytest.mark.parametrize("camera", [LIDAR, RayTable(PINHOLE.rays()), RayTable(random_units(500))])
@pytest.mark.parametrize("half_angle", [0.03, 0.12, 0.4])
@pytest.mark.parametrize("block", [1, 4])
def test_no_cone_has_more_pixels_than_the_bound(camera: RayTable, half_angle: float, block: int) -> None:
    if block > 1 and not camera.has_pattern:
        return
    units = camera.rays() / np.linalg.norm(camera.rays(), axis=-1, keepdims=True)
    v, u = np.indices(camera.shape)
    middle = camera.directions(
        np.minimum(u // block * block + 0.5 * (block - 1), camera.width - 1),
        np.minimum(v // block * block + 0.5 * (block - 1), camera.height - 1),
    )
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    axes = np.concatenate([units.reshape(-1, 3)[::7], random_units(50, 1)])
    cosine = np.cos(half_angle)
    inside = [((units @ axis >= cosine) | (middle @ axis >= cosine)).sum() for axis in axes]
    bound = camera.most_pixels_in_cone(half_angle, block)
    assert max(inside) <= bound <= camera.width * camera.height


def test_the_bound_is_not_far_from_what_a_small_cone_has() -> None:
    fine = SphericalCamera(np.linspace(0.4, -0.4, 128), np.linspace(np.pi, -np.pi, 1024, endpoint=False))
    level = fine.rays().reshape(-1, 3) @ [1.0, 0.0, 0.0] >= np.cos(0.1)
    assert level.sum() <= fine.most_pixels_in_cone(0.1, 1) <= 4 * level.sum()


def test_a_cloud_becomes_rays_whose_neighbours_are_near_each_other() -> None:
    points = random_units(4000) * np.random.default_rng(1).uniform(1.0, 9.0, (4000, 1))
    points[5], points[6] = np.nan, 0.0
    camera, ranges = RayTable.of_points(points)
    assert camera.shape == ranges.shape == (1, 3998)
    assert not camera.has_pattern
    assert camera.pixels_per_radian == 0.0
    back = (camera.rays() * ranges[..., None])[0]
    kept = np.delete(points, (5, 6), axis=0)
    np.testing.assert_allclose(
        back[np.lexsort(back.T.round(3))], kept[np.lexsort(kept.T.round(3))], atol=1e-5
    )
    steps = np.linalg.norm(np.diff(camera.rays()[0], axis=0), axis=1)
    assert np.median(steps) < 0.1  # at random it would be 1.4


def test_up_is_the_z_of_lidars_and_the_minus_y_of_cameras() -> None:
    assert up_of(np.eye(4), LIDAR.up) == (2, 1)
    assert up_of(np.eye(4), RayTable(PINHOLE.rays()).up) == up_of(np.eye(4), PINHOLE.up) == (1, -1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: RayTable(np.zeros((3, 4))), r"\(N, 3\), not \(3, 4\)"),
        (lambda: RayTable(np.zeros((0, 3))), "not"),
        (lambda: RayTable([[[1.0, 0, 0], [0, 0, 0]]]), "column 1, row 0 is not finite or has no length"),
        (lambda: RayTable([[np.nan, 0, 1]]), "column 0, row 0"),
        (lambda: RayTable([[1e300, 0, 1]]), "column 0, row 0"),
        (lambda: RayTable.of_points(np.zeros((4, 3))), "no point of the cloud"),
        (lambda: RayTable.of_points(np.zeros((4, 2))), r"must be of shape \(N, 3\)"),
        (lambda: SphericalCamera([0.0, 0.1], [0.0], [0.1]), "1 values, but there are 2 elevations"),
        (lambda: SphericalCamera([], [0.0]), "elevations_rad must be of shape"),
        (lambda: SphericalCamera([30.0], [0.0]), "in degrees"),
        (lambda: SphericalCamera([0.0], [np.inf]), "azimuths_rad holds a value that is not finite"),
    ],
)
def test_impossible_tables_are_refused(make: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make()
