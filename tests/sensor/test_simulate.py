"""The simulated sensor: its noise has the moments that were asked for, and the right pixels drop out."""

import dataclasses
from math import erfc, sqrt
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError, FrameError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PatchNoise, PolynomialNoise
from taichi_mrf.sensor.simulate import (
    KINECT_1,
    KINECT_1_LATERAL,
    SimulatedSensor,
    incidence,
    simulate,
    simulate_model,
)

CAMERA = PinholeCamera(width=320, height=240, fx=262.5, fy=262.5, cx=159.5, cy=119.5)
PERFECT = SimulatedSensor(sigma=(0.0,))


def wall(depth: float) -> NDArray[np.float32]:
    """A wall square to the optical axis."""
    return np.full(CAMERA.shape, depth, np.float32)


def plane(normal: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Axial depth of the plane normal . x = distance, 0 where it is not met."""
    facing = CAMERA.rays() @ normal
    return np.where(facing > 1e-3, distance / np.maximum(facing, 1e-3), 0.0)


@pytest.mark.parametrize("depth", [0.8, 2.0, 4.0])
def test_mean_and_deviation_follow_the_polynomials(depth: float) -> None:
    sensor = SimulatedSensor(sigma=(0.01, -0.00095, 0.00857), bias=(0.002, -0.01, 0.004))
    measured = simulate(wall(depth), CAMERA, sensor, seed=3).astype(np.float64)
    sigma = 0.01 - 0.00095 * depth + 0.00857 * depth**2
    bias = 0.002 - 0.01 * depth + 0.004 * depth**2
    n = measured.size
    assert (measured > 0).all()
    # five standard errors of a mean and of a deviation
    assert abs(measured.mean() - depth - bias) < 5 * sigma / np.sqrt(n)
    assert abs(measured.std() - sigma) < 5 * sigma / np.sqrt(2 * n)


def test_the_default_is_the_published_kinect() -> None:
    sigma = np.polynomial.polynomial.polyval(3.0, SimulatedSensor().sigma)
    assert sigma == pytest.approx(0.0012 + 0.0019 * (3.0 - 0.4) ** 2, abs=1e-5)  # the paper's own form


@given(st.integers(0, 2**31), st.integers(0, 1000))
def test_the_same_seed_gives_the_same_image(seed: int, index: int) -> None:
    small = PinholeCamera(width=8, height=6, fx=7, fy=7, cx=3.5, cy=2.5)
    clean = np.full(small.shape, 2.0, np.float32)
    once = simulate(clean, small, seed=(seed, index))
    np.testing.assert_array_equal(once, simulate(clean, small, seed=(seed, index)))
    assert (once != simulate(clean, small, SimulatedSensor(), seed=(seed, index + 1))).any()


def test_negative_sigma_adds_no_noise() -> None:
    measured = simulate(wall(2.0), CAMERA, SimulatedSensor(sigma=(0.01, -0.02)), seed=0)
    np.testing.assert_array_equal(measured, wall(2.0))


@pytest.mark.parametrize("depth", [0.6, 1.0, 3.1, 7.0])
def test_steps_of_disparity(depth: float) -> None:
    sensor = dataclasses.replace(SimulatedSensor(), depth_step=0.00285)
    measured = simulate(wall(depth), CAMERA, sensor, seed=1).astype(np.float64)
    counts = 1 / (measured * 0.00285)
    np.testing.assert_allclose(counts, np.round(counts), rtol=1e-6)
    rounding = simulate(wall(depth), CAMERA, dataclasses.replace(PERFECT, depth_step=0.00285))
    assert np.abs(rounding - depth).max() <= 0.51 * 0.00285 * depth**2


def test_missing_and_out_of_range_stay_without_measurement() -> None:
    clean = wall(2.0)
    clean[0, :6] = (0.0, np.nan, -1.0, np.inf, 0.1, 9.0)
    measured = simulate(clean, CAMERA, PERFECT)
    assert (measured[0, :6] == 0).all()
    assert np.isfinite(measured).all()
    np.testing.assert_array_equal(measured[2:], clean[2:])


def test_pixels_on_both_sides_of_a_jump_drop_out() -> None:
    clean = wall(2.0)
    clean[:, 160:] = 3.0
    measured = simulate(clean, CAMERA, PERFECT)
    lost = np.flatnonzero((measured == 0).all(axis=0))
    np.testing.assert_array_equal(lost, [159, 160])
    assert (measured[:, :159] == 2.0).all()
    assert (measured[:, 161:] == 3.0).all()


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0, 1.3])
@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_incidence_is_the_angle_to_a_planes_normal(tilt: float, turn: float) -> None:
    normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    depth = plane(normal, 1.5)
    rays = CAMERA.rays() / CAMERA.range_per_depth()[..., None]
    expected = np.arccos(np.clip(rays @ normal, -1, 1))
    inner = np.zeros(CAMERA.shape, bool)
    inner[1:-1, 1:-1] = True
    for rows in (slice(None, -2), slice(2, None)):  # all neighbours on the plane
        inner[1:-1] &= depth[rows] > 0
    for columns in (slice(None, -2), slice(2, None)):
        inner[:, 1:-1] &= depth[:, columns] > 0
    inner &= depth > 0
    assert inner.sum() > 1000
    np.testing.assert_allclose(incidence(depth, CAMERA)[inner], expected[inner], atol=1e-5)


def test_a_grazing_floor_drops_out_beyond_its_angle() -> None:
    floor = plane(np.array([0.0, 1.0, 0.0]), 1.2)
    sensor = dataclasses.replace(PERFECT, largest_incidence=np.deg2rad(75), largest_jump=10.0, max_depth=1e3)
    seen = simulate(floor.astype(np.float32), CAMERA, sensor) > 0
    rays = CAMERA.rays() / CAMERA.range_per_depth()[..., None]
    angle = np.rad2deg(np.arccos(rays[..., 1]))  # over 90 degrees: above the horizon
    assert seen[angle < 74.5].all()
    assert not seen[angle > 75.5].any()


def test_kinect_noise_is_unbiased_in_spite_of_its_steps() -> None:
    measured = simulate(wall(3.05), CAMERA, KINECT_1, seed=5).astype(np.float64)
    step = 0.00285 * 3.05**2
    assert abs(measured.mean() - 3.05) < 0.02 * step


def edge_at(column: int, near: float = 2.0, far: float = 3.0) -> NDArray[np.float32]:
    """A near wall on the left of a far one, both square to the optical axis."""
    clean = wall(near)
    clean[:, column:] = far
    return clean


def tilted(degrees: float) -> NDArray[np.float64]:
    """A plane 2 m along the optical axis that is turned about the image's vertical."""
    angle = np.deg2rad(degrees)
    return plane(np.array([np.sin(angle), 0.0, np.cos(angle)]), 2.0 * np.cos(angle))


LATERAL = dataclasses.replace(PERFECT, lateral_sigma_px=0.8, largest_jump=1e9, largest_incidence=np.pi)


def test_lateral_noise_frays_an_edge_and_never_mixes_depths() -> None:
    measured = simulate(edge_at(160), CAMERA, LATERAL, seed=4)
    np.testing.assert_array_equal(np.unique(measured), [2.0, 3.0])
    for beside in range(3):  # pixels whose centre is half a pixel, one and a half, ... beside the edge
        crossing = 0.5 * erfc((beside + 0.5) / 0.8 / sqrt(2))
        deviation = sqrt(crossing * (1 - crossing) / CAMERA.height)
        assert abs((measured[:, 159 - beside] == 3.0).mean() - crossing) < 5 * deviation
        assert abs((measured[:, 160 + beside] == 2.0).mean() - crossing) < 5 * deviation


@pytest.mark.parametrize(("sensor", "wanted_px"), [(LATERAL, 0.8), (KINECT_1_LATERAL, None)])
def test_lateral_noise_on_a_tilted_plane_is_a_shift_along_it(
    sensor: SimulatedSensor, wanted_px: float | None
) -> None:
    clean = tilted(40)
    sensor = dataclasses.replace(sensor, sigma=(0.0,), steep_sigma=0.0, depth_step=0.0)
    sensor = dataclasses.replace(sensor, largest_jump=1e9, max_depth=1e3)
    measured = simulate(clean.astype(np.float32), CAMERA, sensor, seed=6).astype(np.float64)
    inner = np.s_[:, 5:-5]  # where no shift leaves the image
    slope = np.diff(1 / clean, axis=1).mean()  # of the inverse depth, per pixel
    shift_px = ((1 / measured - 1 / clean) / slope)[inner]
    angle = incidence(clean, CAMERA)[inner]
    expected = 0.8 if wanted_px else 0.8 + 0.035 * angle / (np.pi / 2 - angle)
    assert abs((shift_px / expected).mean()) < 5 / np.sqrt(shift_px.size)
    assert abs((shift_px / expected).std() - 1) < 5 / np.sqrt(2 * shift_px.size)


@pytest.mark.parametrize("degrees", [40.0, 72.0])
def test_axial_noise_grows_on_steep_surfaces(degrees: float) -> None:
    clean = tilted(degrees)
    sensor = dataclasses.replace(SimulatedSensor(), steep_sigma=0.0001, largest_jump=1e9, max_depth=50.0)
    measured = simulate(clean.astype(np.float32), CAMERA, sensor, seed=8).astype(np.float64)
    angle = incidence(clean, CAMERA)
    sigma = 0.0012 + 0.0019 * (clean - 0.4) ** 2
    seen = (measured > 0) & (np.abs(angle - np.deg2rad(60)) > 1e-4)
    clean, sigma, angle = clean[seen], sigma[seen], angle[seen]
    more = 0.0001 * angle**2 / (np.pi / 2 - angle) ** 2 / np.sqrt(clean)
    sigma += np.where(angle >= np.deg2rad(60), more, 0)
    normalised = (measured[seen] - clean) / sigma
    assert seen.mean() > 0.3
    assert abs(normalised.std() - 1) < 5 / np.sqrt(2 * seen.sum())


def test_the_tilt_beside_an_edge_is_the_surfaces_own() -> None:
    clean = edge_at(160).astype(np.float64)
    rays = CAMERA.rays() / CAMERA.range_per_depth()[..., None]
    facing = np.arccos(rays[..., 2])
    np.testing.assert_allclose(incidence(clean, CAMERA, across_edges=False), facing, atol=1e-6)
    assert incidence(clean, CAMERA)[:, 159:161].min() > np.deg2rad(85)


def test_the_full_kinect_measures_whole_steps_of_disparity_and_repeats_itself() -> None:
    clean = tilted(30).astype(np.float32)
    clean[:100] = edge_at(160)[:100]
    measured = simulate(clean, CAMERA, KINECT_1_LATERAL, seed=(2, 3))
    seen = measured > 0
    assert 0.9 < seen.mean() < 1
    counts = 1 / (measured[seen].astype(np.float64) * 0.00285)
    np.testing.assert_allclose(counts, np.round(counts), rtol=1e-6)
    np.testing.assert_array_equal(measured, simulate(clean, CAMERA, KINECT_1_LATERAL, seed=(2, 3)))
    assert (measured != simulate(clean, CAMERA, KINECT_1_LATERAL, seed=(2, 4))).any()


def test_a_place_without_a_surface_measures_nothing() -> None:
    clean = edge_at(160)
    clean[:, 160:] = 0
    measured = simulate(clean, CAMERA, LATERAL, seed=1)
    np.testing.assert_array_equal(np.unique(measured), [0.0, 2.0])
    # Column 159 is at a jump, so what is looked at from half a pixel beyond 158 on is lost.
    lost = 0.5 * erfc(0.5 / 0.8 / sqrt(2))
    assert abs((measured[:, 158] == 0).mean() - lost) < 5 * sqrt(lost * (1 - lost) / CAMERA.height)
    assert (measured[:, :150] == 2.0).all()


def patch_noise(camera: PinholeCamera, patch: int) -> PatchNoise:
    """Each patch with a bias and sigma of its own."""
    patches = -(-camera.width // patch) * -(-camera.height // patch)
    random = np.random.default_rng(0)
    sigma = random.uniform((0.002, 0.0, 0.001), (0.01, 0.002, 0.004), (patches, 3))
    bias = random.uniform(-0.01, 0.01, (patches, 3))
    return PatchNoise(sigma, bias, patch, camera)


def test_draws_from_a_table_have_its_bias_and_sigma_in_every_patch() -> None:
    noise = patch_noise(CAMERA, 40)
    clean = np.linspace(1.0, 3.0, CAMERA.width, dtype=np.float32) * np.ones(CAMERA.shape, np.float32)
    draws = [simulate_model(clean, CAMERA, noise, seed=(1, i)).astype(np.float64) for i in range(4)]
    for row in range(6):
        for column in range(8):
            part = np.s_[40 * row : 40 * row + 40, 40 * column : 40 * column + 40]
            z = clean[part].astype(np.float64)
            patch = row * 8 + column
            bias = np.polynomial.polynomial.polyval(z, noise.bias[patch])
            sigma = np.polynomial.polynomial.polyval(z, noise.sigma[patch])
            normalised = np.array([(draw[part] - z - bias) / sigma for draw in draws])
            assert abs(normalised.mean()) < 5 / np.sqrt(normalised.size)
            assert abs(normalised.std() - 1) < 5 / np.sqrt(2 * normalised.size)


def test_a_sigma_below_the_least_is_drawn_at_the_least() -> None:
    measured = simulate_model(wall(2.0), CAMERA, PolynomialNoise((-0.5,), (0.25,)), seed=7)
    normal = np.random.default_rng(7).standard_normal(CAMERA.shape)
    np.testing.assert_array_equal(measured, (2.25 + 1e-3 * normal).astype(np.float32))


def test_draws_stand_only_where_there_is_a_surface() -> None:
    clean = wall(0.2)
    clean[0, :4] = (0.0, np.nan, -1.0, np.inf)
    measured = simulate_model(clean, CAMERA, PolynomialNoise((0.2,)), seed=0)
    assert (measured[0, :4] == 0).all()
    assert (measured >= 0).all()
    assert (measured > 0).mean() == pytest.approx(0.5 * erfc(-1 / sqrt(2)), abs=0.01)


def test_draws_repeat_themselves() -> None:
    noise = patch_noise(CAMERA, 40)
    once = simulate_model(wall(2.0), CAMERA, noise, seed=(3, 1))
    np.testing.assert_array_equal(once, simulate_model(wall(2.0), CAMERA, noise, seed=(3, 1)))
    assert (once != simulate_model(wall(2.0), CAMERA, noise, seed=(3, 2))).mean() > 0.999


def test_images_and_tables_of_the_wrong_size() -> None:
    other = PinholeCamera(width=160, height=120, fx=131, fy=131, cx=79.5, cy=59.5)
    with pytest.raises(FrameError, match=r"\(240, 320\).*\(120, 160\)"):
        simulate(wall(2.0), other)
    with pytest.raises(FrameError, match=r"\(240, 320\).*\(120, 160\)"):
        simulate_model(wall(2.0), other, PolynomialNoise((0.01,)))
    with pytest.raises(ConfigError, match="learnt at 160 x 120"):
        simulate_model(wall(2.0), CAMERA, patch_noise(other, 20))


@pytest.mark.shared_data
def test_the_coffin_scene_draws_as_its_published_numbers_did(shared_data: Path) -> None:
    folder = shared_data / "coffin_world"
    views = np.load(folder / "clean_depth.npz")
    K = views["K"]
    camera = PinholeCamera(640, 480, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    sigma, bias = (np.load(folder / f"realsense_{name}_poly5x.npy") for name in ("stddev", "bias"))
    noise = PatchNoise(sigma, bias, 20, camera)
    for i in (0, 7):
        z = views["depth_m"][i].astype(np.float64)
        b, s = (np.kron(table.reshape(24, 32, 3), np.ones((20, 20, 1))) for table in (bias, sigma))
        spread = np.maximum(s[..., 0] + z * (s[..., 1] + z * s[..., 2]), 1e-3)
        normal = np.random.default_rng(100 + i).standard_normal(z.shape)
        expected = z + (b[..., 0] + z * (b[..., 1] + z * b[..., 2])) + spread * normal
        measured = simulate_model(views["depth_m"][i], camera, noise, seed=100 + i)
        np.testing.assert_array_equal(measured, np.nan_to_num(expected).astype(np.float32))
