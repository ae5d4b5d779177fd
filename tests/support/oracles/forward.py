"""The forward sensor model in float64, from the exact error function and numpy.polynomial."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike, NDArray

LEAST_SIGMA_M = 1e-3
"""A sensor is not taken to be more precise than this, whatever its fitted polynomial says."""

_erf = np.vectorize(math.erf, otypes=[np.float64])
_erfc = np.vectorize(math.erfc, otypes=[np.float64])


def normal_density(x: ArrayLike) -> NDArray[np.float64]:
    """Standard normal density."""
    return np.exp(-0.5 * np.asarray(x, np.float64) ** 2) / math.sqrt(2 * math.pi)


def normal_between(low: ArrayLike, high: ArrayLike) -> NDArray[np.float64]:
    """Standard normal probability of [low, high]; the far tails keep their digits."""
    a, b = (np.asarray(x, np.float64) / math.sqrt(2) for x in (low, high))
    right = 0.5 * (_erfc(a) - _erfc(b))
    left = 0.5 * (_erfc(-b) - _erfc(-a))
    middle = 0.5 * (_erf(b) - _erf(a))
    return np.where(a >= 0, right, np.where(b <= 0, left, middle))


@dataclass(frozen=True)
class Noise:
    """One pixel's polynomials, ascending powers of axial depth, metres."""

    sigma: tuple[float, ...]
    bias: tuple[float, ...] = (0.0,)

    def sigma_at(self, depth: ArrayLike) -> NDArray[np.float64]:
        """Standard deviation of the measurement of a surface at ``depth``."""
        return np.maximum(polynomial.polyval(np.asarray(depth, np.float64), self.sigma), LEAST_SIGMA_M)

    def bias_at(self, depth: ArrayLike) -> NDArray[np.float64]:
        """Mean of measured minus true depth."""
        return np.asarray(polynomial.polyval(np.asarray(depth, np.float64), self.bias))

    def deviation(self, measured: ArrayLike, depth: ArrayLike) -> NDArray[np.float64]:
        """Sigmas by which the measurement exceeds what a surface at ``depth`` gives on average."""
        z = np.asarray(depth, np.float64)
        return (np.asarray(measured, np.float64) - z - self.bias_at(z)) / self.sigma_at(z)

    def depth_of_deviation(self, measured: ArrayLike, sigmas: float) -> NDArray[np.float64]:
        """The depth at which :meth:`deviation` is ``sigmas``, by bisection.

        It must fall with depth up to twice the measurement and 2 m. 0 where it is less from the camera on.
        """
        far = 2.0 * np.asarray(measured, np.float64) + 2.0
        near = np.zeros_like(far)
        for _ in range(60):
            middle = 0.5 * (near + far)
            before = self.deviation(measured, middle) > sigmas
            near, far = np.where(before, middle, near), np.where(before, far, middle)
        return near

    def density_at(self, measured: ArrayLike, depth: ArrayLike) -> NDArray[np.float64]:
        """Density of the measurement of a surface at ``depth``, per metre."""
        return normal_density(self.deviation(measured, depth)) / self.sigma_at(depth)

    def density_over(self, measured: ArrayLike, near: ArrayLike, far: ArrayLike) -> NDArray[np.float64]:
        """Density averaged over a segment of depths, with the sigma of its centre."""
        near_, far_, measured_ = (np.asarray(x, np.float64) for x in (near, far, measured))
        sigma = self.sigma_at(0.5 * (near_ + far_))
        high = (measured_ - near_ - self.bias_at(near_)) / sigma
        low = (measured_ - far_ - self.bias_at(far_)) / sigma
        return normal_between(low, high) / (sigma * (high - low))
