"""The factor on sigma and the law of sigma, against measurements of a known noise."""

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf import open_dataset
from taichi_mrf.config.schema import Config, EvaluationConfig, SensorConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.noise_fit import (
    LEAST_PIXELS,
    OCTAVES,
    Explained,
    NoiseCheck,
    check_noise,
    explained,
    pooled,
    sigma_factor,
    sigma_law,
)
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.voxels.traversal import FAR

N = 20_000
STEP = 2.0 ** (1 / 16)
"""The factor between neighbouring answers of sigma_factor."""

NEAR_ENOUGH = STEP * math.exp(5.0 / math.sqrt(2 * N))
"""Five standard errors of the logarithm of a standard deviation, and a step."""


def normal(sigma_m: NDArray[np.float64], true_m: NDArray[np.float64], seed: int = 0) -> Explained:
    """Measurements whose noise has the standard deviations ``true_m`` where ``sigma_m`` is assumed."""
    residual = np.random.default_rng(seed).standard_normal(len(sigma_m)) * true_m
    tried = sigma_m[:, None] * 2.0**OCTAVES
    density = -0.5 * (residual[:, None] / tried) ** 2 - np.log(tried * math.sqrt(2 * math.pi))
    return Explained(sigma_m, sigma_m, density)


@pytest.mark.parametrize("factor", [0.3, 1.0, 2.5, 9.0])
def test_the_factor_between_true_and_assumed_sigma_is_found(factor: float) -> None:
    sigma_m = np.random.default_rng(1).uniform(0.005, 0.05, N)
    found = sigma_factor(normal(sigma_m, factor * sigma_m))
    assert factor / NEAR_ENOUGH < found < factor * NEAR_ENOUGH


def test_measurements_that_nothing_explains_do_not_move_the_factor() -> None:
    sigma_m = np.full(N, 0.01)
    right = normal(sigma_m, 3.0 * sigma_m)
    wild = Explained(sigma_m, sigma_m, np.full((N, len(OCTAVES)), math.log(1e-3)))
    both = pooled([right, None, wild])
    assert both is not None
    assert sigma_factor(both) == sigma_factor(right)
    assert both.mean(0.01) == pytest.approx(0.5 * (right.mean(0.01) + math.log(1e-3)))


def test_what_voxels_add_is_set_aside() -> None:
    sigma_m = np.random.default_rng(4).uniform(0.01, 0.02, N)
    blurred = normal(sigma_m, np.hypot(2.0 * sigma_m, 0.03))
    assert sigma_factor(blurred) > 2.0 * NEAR_ENOUGH
    # The factor is a part of the standard deviation only, so it is as much less certain.
    assert sigma_factor(dataclasses.replace(blurred, voxel_m=0.03)) == pytest.approx(2.0, rel=0.1)


def test_the_law_of_sigma_is_found() -> None:
    sigma_m = np.random.default_rng(2).uniform(0.002, 0.05, N)
    true_m = 0.02 + 0.7 * sigma_m
    measured = normal(sigma_m, true_m)
    law = sigma_law(measured, sigma_factor(measured))
    found_m = law.added_m + law.scale * sigma_m
    # Two parameters: each end of the line is as uncertain as if half of the measurements decided it.
    assert np.abs(np.log(found_m / true_m)).max() < 5.0 / math.sqrt(N / 2) + 0.03


def test_a_law_over_the_stated_sigma_does_not_depend_on_the_assumed_one() -> None:
    stated_m = np.random.default_rng(3).uniform(0.005, 0.02, N)
    laws = []
    for assumed in (1.0, 2.0):
        measured = dataclasses.replace(normal(assumed * stated_m, 3.0 * stated_m), stated_m=stated_m)
        laws.append(sigma_law(measured, sigma_factor(measured)))
    middle_m = float(np.median(stated_m))
    sigmas = [law.added_m + law.scale * middle_m for law in laws]
    assert sigmas == pytest.approx([3.0 * middle_m] * 2, rel=0.03)


def test_few_measurements_tell_nothing() -> None:
    few = np.full(LEAST_PIXELS - 1, 0.01)
    assert pooled([normal(few, few)]) is None
    assert pooled([]) is None


@pytest.fixture(scope="module")
def room() -> Dataset:
    return open_dataset("synthetic:room?frames=16&width=160&height=120", color=False)


def checked(room: Dataset, scale: float) -> NoiseCheck:
    """Check of a map's noise that is a multiple of the right one."""
    config = Config(0.05, sensor=SensorConfig(sigma_scale=scale), evaluation=EvaluationConfig(hold_out=4))
    result = map_sequence(room, config)
    check = check_noise(result.map, map(room.read, result.held_out))
    assert check is not None
    assert check.frames == len(result.held_out) == 4
    return check


@pytest.mark.usefixtures("one_backend")
def test_each_multiple_of_sigma_explains_measurements_as_a_noise_of_its_own(room: Dataset) -> None:
    result = map_sequence(room, Config(0.05, evaluation=EvaluationConfig(hold_out=4)))
    m, frame = result.map, room.read(result.held_out[0])
    kept = np.zeros_like(frame.depth_m)
    kept[::4, ::4] = frame.depth_m[::4, ::4]
    sigma = (0.002, 0.001, 0.002)
    found = explained(m, kept, frame.T_world_camera, frame.camera, PolynomialNoise(sigma))
    assert found is not None
    trusting = m.view.with_occlusion(least=-FAR, most=FAR)
    for k, octave in enumerate(OCTAVES):
        noise = PolynomialNoise(2.0**octave * np.array(sigma))
        view = judge_view(m, kept, frame.T_world_camera, frame.camera, noise=noise, view=trusting)
        # Tails of the normal distribution are exact to 1e-7 (sensor.forward), whose logarithm says more.
        np.testing.assert_allclose(found.log_likelihood[:, k], view.log_densities(), rtol=0, atol=2e-3)


@pytest.mark.usefixtures("one_backend")
def test_a_map_notices_a_wrong_noise_and_is_content_with_the_right_one(room: Dataset) -> None:
    assert not checked(room, 1.0).wrong
    too_small, too_large = checked(room, 0.2), checked(room, 5.0)
    assert too_small.wrong
    assert too_small.factor > 3.0
    assert too_large.wrong
    # Less than a fifth may be wanted: the map is spread by the wrong sigma too, which stands for noise.
    assert too_large.factor < 0.4
