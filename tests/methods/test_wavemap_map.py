"""WavemapMap: the measurement model in closed form, and scans of several cameras against NumPy."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracles import wavemap as reference

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.config.sections import WavemapConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.wavemap.map import WavemapMap
from taichi_mrf.methods.wavemap.model import BeamModel, cumulative
from taichi_mrf.queries.points import UNKNOWN
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.types import F32, F32Array

pytestmark = pytest.mark.usefixtures("backend")

VOXEL = 0.2
MAX_DEPTH = 2.5
T_WORLD_SENSOR = np.eye(4)
T_WORLD_SENSOR[:3, :3] = [[0.36, -0.8, 0.48], [0.48, 0.6, 0.64], [-0.8, 0.0, 0.6]]
T_WORLD_SENSOR[:3, 3] = [0.317, -0.213, 0.104]

WIDE: dict[str, Any] = {"angle_sigma_deg": 1.5, "range_sigma": 0.15}
"""Beams so wide that many voxels lie between several of them."""


@kernel
def _cumulative(t: F32Array, out: F32Array) -> None:
    for i in range(t.shape[0]):
        out[i] = cumulative(t[i])


@kernel
def _log_odds(model: BeamModel, distance: F32, measured: F32, angle: F32, out: F32Array) -> None:
    for i in range(out.shape[0]):
        out[i] = model.log_odds(distance, measured, angle)


def of_one_beam(distance: float, measured: float, angle: float, config: WavemapConfig) -> float:
    model = BeamModel(
        config.range_sigma_at(VOXEL), config.angle_sigma, config.scaling_free, config.scaling_occupied,
        int(config.beams == "ray"),
    )  # fmt: skip
    out = np.zeros(1, np.float32)
    _log_odds(model, distance, measured, angle, out)
    return float(out[0])


def test_the_approximate_gaussian_is_a_smooth_symmetric_distribution() -> None:
    t = np.linspace(-4, 4, 3201).astype(np.float32)
    found = np.zeros_like(t)
    _cumulative(t, found)
    np.testing.assert_allclose(found, reference.cumulative(t.astype(float)), atol=1e-6)
    np.testing.assert_allclose(found + found[::-1], 1.0, atol=1e-6)
    density = np.diff(found.astype(float)) / np.diff(t)
    assert (density >= -1e-4).all()
    # Neither the distribution nor its density jumps, at the ends of the pieces or anywhere.
    assert np.abs(np.diff(found)).max() < 1.1 * 0.375 * 0.0025
    assert np.abs(np.diff(density)).max() < 1e-3
    assert np.average(t[1:] ** 2, weights=density.clip(0)) == pytest.approx(1.0, abs=0.01)


ANGLES = st.floats(0.0, 0.0625, width=32, allow_subnormal=False)
RANGES = st.floats(0.5, 20.0, width=32)


@given(RANGES, RANGES, ANGLES, st.sampled_from(["neighbours", "ray"]))
def test_a_beam_says_what_the_paper_says(distance: float, measured: float, angle: float, beams: Any) -> None:
    config = WavemapConfig(angle_sigma_deg=0.4, range_sigma=0.7, beams=beams)
    expected = reference.change(*(np.array(each) for each in (distance, measured, angle)), config, VOXEL)
    assert of_one_beam(distance, measured, angle, config) == pytest.approx(float(expected), abs=1e-5)


def test_known_values_of_the_model() -> None:
    config = WavemapConfig()
    sigma, off = config.range_sigma_at(VOXEL), config.angle_sigma
    assert sigma == pytest.approx(0.1)
    assert WavemapConfig().range_sigma_at(0.05) == pytest.approx(0.05)
    # In front of the surface p is 0.4, half as far from 0.5 half-way to the beam's edge, at the surface 0.5.
    assert of_one_beam(1.0, 5.0, 0.0, config) == pytest.approx(math.log(0.4 / 0.6), abs=1e-5)
    assert of_one_beam(1.0, 5.0, 3 * off, config) == pytest.approx(math.log(0.45 / 0.55), abs=1e-5)
    assert of_one_beam(1.0, 5.0, 6 * off, config) == pytest.approx(0.0, abs=1e-5)
    assert of_one_beam(5.0, 5.0, 0.0, config) == pytest.approx(0.0, abs=1e-5)
    behind = (1 - 1.5**3 / 48) - (1.5**3 / 48) / 2 - 0.5
    p = 0.5 + 0.4 * behind
    assert of_one_beam(5.0 + 1.5 * sigma, 5.0, 0.0, config) == pytest.approx(math.log(p / (1 - p)), abs=1e-4)
    assert of_one_beam(5.0 + 6 * sigma, 5.0, 0.0, config) == pytest.approx(0.0, abs=1e-4)


def rough(camera: Camera, seed: int = 0) -> NDArray[np.float32]:
    """Depths of a rough surface with holes, some beyond the sensor's range."""
    random = np.random.default_rng(seed)
    depth = random.uniform(0.7, 2.9, camera.shape)
    depth[random.random(camera.shape) < 0.2] = 0
    return depth.astype(np.float32)


def free_rays() -> RayTable:
    random = np.random.default_rng(3)
    rays = random.normal(size=(60, 3))
    rays[:2] = [[0.01, 0.0, 1.0], [0.0, -0.01, -1.0]]  # near the poles
    rays[2:6] = random.normal((-1.0, 0.0, 0.1), 0.02, (4, 3))  # where azimuths begin anew
    return RayTable(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def moving() -> RayTable:
    """A lidar that goes 30 cm while it turns."""
    rays = SphericalCamera(
        np.radians(np.linspace(30, -30, 9)), np.radians(np.arange(0.0, 360.0, 12.0))
    ).rays()
    return RayTable(rays, np.linspace((-0.15, 0.0, 0.0), (0.15, 0.05, 0.0), rays.shape[1]))


CAMERAS: dict[str, Camera] = {
    "pinhole": PinholeCamera(9, 7, 9.0, 9.0, 4.0, 3.0),
    "lidar": SphericalCamera(np.radians(np.linspace(30, -30, 11)), np.radians(np.arange(0.0, 360.0, 10.0))),
    "free rays": free_rays(),
    "moving lidar": moving(),
}


def around(T: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
    """The centres of all voxels up to some distance along the axes."""
    near = np.floor(T[:3, 3] / VOXEL)
    axis = np.arange(-int(reach_m / VOXEL) - 1, int(reach_m / VOXEL) + 2)
    return (np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) + near + 0.5) * VOXEL


def known(m: WavemapMap, centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
    p = m.occupancy(centres_m).astype(np.float64)
    return np.log(p / (1 - p))


@pytest.mark.parametrize("beams", ["neighbours", "nearest", "ray"])
@pytest.mark.parametrize("name", CAMERAS)
def test_a_scan_changes_each_voxel_as_numpy_has_it(name: str, beams: Any) -> None:
    camera, config = CAMERAS[name], WavemapConfig(beams=beams, **WIDE)
    depth = rough(camera)
    m = WavemapMap(VOXEL, wavemap=config, max_depth=MAX_DEPTH)
    m.add_keyframe(depth, T_WORLD_SENSOR, camera)
    points = points_at(camera, depth)[depth > 0]
    centres = around(T_WORLD_SENSOR, MAX_DEPTH + 0.2)
    centres = np.random.default_rng(1).choice(centres, 5000, replace=False)
    if name == "pinhole":  # its rays go to the same depth, which is a longer range near the image's edge
        centres = centres[np.linalg.norm(centres - T_WORLD_SENSOR[:3, 3], axis=1) < MAX_DEPTH - 0.05]
    expected = reference.scan_change(centres, T_WORLD_SENSOR, points, config, VOXEL, MAX_DEPTH)
    sure = np.isfinite(expected)
    assert sure.mean() > 0.99
    low, high = (math.log(p / (1 - p)) for p in (config.lowest, config.highest))
    found = known(m, centres)
    np.testing.assert_allclose(found[sure], np.clip(expected, low, high)[sure], atol=2e-3)
    assert (found[sure] > 0.02).sum() > 20
    assert (found[sure] < -0.02).sum() > 40
    if beams == "neighbours":
        assert (found < math.log(0.4 / 0.6) - 0.01).any()  # several beams added up


def test_scans_add_up_and_are_clamped() -> None:
    camera = CAMERAS["lidar"]
    depth, centres = rough(camera), around(T_WORLD_SENSOR, 2.0)
    one, many = (WavemapMap(VOXEL, max_depth=MAX_DEPTH, **WIDE) for _ in range(2))
    one.add_keyframe(depth, T_WORLD_SENSOR, camera)
    for _ in range(30):
        many.add_keyframe(depth, T_WORLD_SENSOR, camera)
    single, repeated = known(one, centres), known(many, centres)
    np.testing.assert_allclose(repeated, np.clip(30 * single, -2.0, 4.0), atol=2e-2)
    assert repeated.min() == pytest.approx(-2.0, abs=1e-2)
    # What is taken out is gone.
    for id in list(many.keyframes)[1:]:
        many.remove_keyframe(id)
    many.infer()
    np.testing.assert_array_equal(known(many, centres), single)


def test_nothing_is_said_outside_the_volume_and_beyond_the_range() -> None:
    camera, centres = CAMERAS["lidar"], around(T_WORLD_SENSOR, 3.5)
    volume = VolumeConfig(lower=(-1.0, -1.4, -0.6), upper=(2.0, 1.4, 1.0))
    m = WavemapMap(VOXEL, volume=volume, max_depth=MAX_DEPTH, max_range=1.2, **WIDE)
    m.add_keyframe(rough(camera), T_WORLD_SENSOR, camera)
    inside = ((centres > volume.lower) & (centres < volume.upper)).all(axis=1)
    inside &= np.linalg.norm(centres - T_WORLD_SENSOR[:3, 3], axis=1) < 1.2
    assert (m.state(centres)[~inside] == UNKNOWN).all()
    assert (m.state(centres)[inside] != UNKNOWN).sum() > 50


def test_impossible_parameters_are_refused() -> None:
    for wrong in ({"angle_sigma_deg": 0.0}, {"range_sigma": -1.0}, {"scaling_free": 1.0}, {"lowest": 0.6}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            WavemapMap(VOXEL, **wrong)
