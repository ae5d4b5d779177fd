"""``sensor.sigma_scale`` and ``sensor.sigma_added`` reach every sigma that is stated, and no map file doubles
them."""

from pathlib import Path

import numpy as np
import pytest
from plugged_noise import SquareNoise

from taichi_mrf import MRFMap, PatchNoise, PinholeCamera, PolynomialNoise
from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.methods.registry import create_map, load_map
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import (
    NoiseModel,
    curves_of,
    noise_from_config,
    unwidened_noise,
    widened_noise,
)
from taichi_mrf.sensor.stored import stored_arrays
from taichi_mrf.system.atomic import write_npz

CAMERA = PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5)
WIDER = SensorConfig(sigma=(0.01, 0.0, 0.002), bias=(0.003,), sigma_scale=2.0, sigma_added=0.05)
DEPTH = np.full(CAMERA.shape, 3.0, np.float32)
STATED_M = 0.01 + 0.002 * 9.0


def sigma_m(noise: NoiseModel) -> float:
    sigma, bias = noise.table(CAMERA).at_pixels(DEPTH)
    assert bias.max() == pytest.approx(0.003)
    assert sigma.min() == sigma.max()
    return float(sigma[0, 0])


def patches() -> PatchNoise:
    return PatchNoise([[0.01, 0.0, 0.002]] * 4, [[0.003]] * 4, 4, CAMERA)


def test_the_configuration_s_polynomial_and_table_are_widened(tmp_path: Path) -> None:
    assert sigma_m(noise_from_config(WIDER, CAMERA)) == pytest.approx(2.0 * STATED_M + 0.05)
    np.save(tmp_path / "sigma.npy", patches().sigma)
    table = SensorConfig(
        sigma_table=str(tmp_path / "sigma.npy"), bias=(0.003,), patch=4, sigma_scale=2.0, sigma_added=0.05
    )
    assert sigma_m(noise_from_config(table, CAMERA)) == pytest.approx(2.0 * STATED_M + 0.05)


@pytest.mark.parametrize(
    "noise", [PolynomialNoise((0.01, 0.0, 0.002), (0.003,)), patches(), SquareNoise(0.01, 0.002, 0.003)]
)
def test_noise_that_was_stated_is_widened_and_back(noise: NoiseModel) -> None:
    wider = widened_noise(noise, WIDER)
    assert sigma_m(wider) == pytest.approx(2.0 * STATED_M + 0.05)
    assert sigma_m(unwidened_noise(wider, WIDER)) == pytest.approx(STATED_M)
    assert sigma_m(widened_noise(wider, WIDER)) == pytest.approx(2.0 * (2.0 * STATED_M + 0.05) + 0.05)


def test_a_class_of_its_own_is_the_same_again() -> None:
    square = SquareNoise(0.01, 0.002, 0.003)
    assert unwidened_noise(widened_noise(square, WIDER), WIDER) is square
    assert widened_noise(square, SensorConfig()) is square


def test_what_a_frame_states_is_widened() -> None:
    stated = np.where(np.arange(8) < 4, np.float32(0.1), np.float32(0.0)) * np.ones(CAMERA.shape, np.float32)
    noise = PolynomialNoise((0.01, 0.0, 0.002), (0.003,))
    frame = Frame(DEPTH, np.eye(4), CAMERA, 0.0, "frame", sigma_m=stated, noise=noise)
    own = frame.own_for(WIDER)
    assert own.sigma_m is not None
    assert own.noise is not None
    np.testing.assert_allclose(own.sigma_m, np.where(stated > 0, 0.25, 0.0), rtol=1e-6)
    assert sigma_m(own.noise) == pytest.approx(2.0 * STATED_M + 0.05)
    plain = frame.own_for(SensorConfig())
    assert plain.sigma_m is stated
    assert plain.noise is noise


@pytest.mark.usefixtures("one_backend")
def test_a_saved_map_keeps_the_file_s_noise_as_it_is_widened(tmp_path: Path) -> None:
    write_npz(tmp_path / "noise.npz", stored_arrays(SquareNoise(0.01, 0.002, 0.003)))
    sensor = SensorConfig(sigma_table=str(tmp_path / "noise.npz"), sigma_scale=2.0, sigma_added=0.05)
    sigma, bias = curves_of(sensor)(np.array([0.5, 3.0]))
    np.testing.assert_allclose(sigma, [[2.0 * 0.0105 + 0.05, 2.0 * STATED_M + 0.05]])
    np.testing.assert_array_equal(bias, [[0.003, 0.003]])
    m = create_map(Config(0.2, sensor=sensor), CAMERA)
    m.add_keyframe(DEPTH, np.eye(4), CAMERA)
    m.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    assert loaded.sensor == sensor
    assert sigma_m(loaded.noise) == sigma_m(m.noise) == pytest.approx(2.0 * STATED_M + 0.05)
    assert unwidened_noise(loaded.noise, sensor) == SquareNoise(0.01, 0.002, 0.003)


@pytest.mark.usefixtures("one_backend")
def test_a_saved_map_has_the_same_noise_and_parameters(tmp_path: Path) -> None:
    m = create_map(Config(0.2, sensor=WIDER), CAMERA)
    m.add_keyframe(DEPTH, np.eye(4), CAMERA)
    m.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    assert loaded.sensor == m.sensor == WIDER
    assert sigma_m(loaded.noise) == sigma_m(m.noise) == pytest.approx(2.0 * STATED_M + 0.05)
    # Noise that was given as an object is what it is.
    given = MRFMap(0.2, m.noise)
    assert (given.sensor.sigma_scale, given.sensor.sigma_added) == (1.0, 0.0)
    assert sigma_m(noise_from_config(given.sensor, CAMERA)) == sigma_m(m.noise)
