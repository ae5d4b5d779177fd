"""The configuration's sensor section for a noise model that was given as an object, so that a map's
configuration says what the map was made with."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise, patch_coefficients


def describing(noise: NoiseModel | None, sensor: SensorConfig) -> SensorConfig:
    """``sensor`` with the coefficients of ``noise`` if it is a PolynomialNoise that ``sensor`` does not
    describe yet. Learnt tables and other models have no place in a configuration; they leave it as it is."""
    if not isinstance(noise, PolynomialNoise):
        return sensor
    if sensor.sigma_table is None and sensor.bias_table is None:
        described = PolynomialNoise(*(each[0].tolist() for each in patch_coefficients(sensor)))
        if np.array_equal(described.sigma, noise.sigma) and np.array_equal(described.bias, noise.bias):
            return sensor
    sigma, bias = _coefficients(noise.sigma), _coefficients(noise.bias)
    plain = replace(sensor, sigma_table=None, bias_table=None, sigma_scale=1.0, sigma_added=0.0)
    return replace(plain, sigma=sigma, bias=bias)


def _coefficients(padded: NDArray[np.float64]) -> tuple[float, ...]:
    """A polynomial's coefficients, (1, terms), without zeros at the end."""
    coefficients = np.trim_zeros(padded[0], "b").tolist()
    return tuple(coefficients) or (0.0,)
