"""Noise in kernels, as polynomials of depth for each patch of pixels. How noise plugs in: sensor/model.py."""

from dataclasses import dataclass
from typing import Any, ClassVar

import taichi as ti

from taichi_mrf.kernels.bundles import Bundle
from taichi_mrf.kernels.types import F32, I32, F32Array3, Struct, Vec5
from taichi_mrf.sensor.limits import LEAST_SIGMA_M, TERMS


@ti.func
def polynomial(coefficients: Vec5, depth: F32) -> F32:
    """Horner's rule, ascending powers."""
    value = coefficients[TERMS - 1]
    for term in ti.static(range(TERMS - 2, -1, -1)):
        value = value * depth + coefficients[term]
    return value


@ti.func
def slope(coefficients: Vec5, depth: F32) -> F32:
    """Derivative of a polynomial."""
    value = (TERMS - 1) * coefficients[TERMS - 1]
    for term in ti.static(range(TERMS - 2, 0, -1)):
        value = value * depth + term * coefficients[term]
    return value


@ti.dataclass
class PixelNoise(Struct):
    """The noise of one pixel: coefficients in ascending powers of depth in metres."""

    sigma_terms: Vec5
    bias_terms: Vec5

    @ti.func
    def sigma(self, depth: F32):
        """Standard deviation of the measurement of a surface at ``depth``, at least LEAST_SIGMA_M."""
        return ti.max(polynomial(self.sigma_terms, depth), LEAST_SIGMA_M)

    @ti.func
    def bias(self, depth: F32):
        """Mean of measured minus true depth for a surface at ``depth``, in metres."""
        return polynomial(self.bias_terms, depth)

    @ti.func
    def sigma_slope(self, depth: F32):
        """Derivative of sigma by depth, without the bound from below."""
        return slope(self.sigma_terms, depth)

    @ti.func
    def bias_slope(self, depth: F32):
        """Derivative of the bias by depth."""
        return slope(self.bias_terms, depth)


class SensorNoise(Bundle):
    """The base of all noise in kernels."""

    at_pixel: ClassVar[Any]
    """A ti.func, as PolynomialTable has it. What it returns has the methods of PixelNoise, and may hold
    whatever a pixel needs."""


@dataclass(frozen=True)
class PolynomialTable(SensorNoise):
    """The polynomials of each square patch of pixels (noise.NoiseTable)."""

    coefficients: F32Array3
    """(patches, 2, TERMS): sigma, then bias, in ascending powers of depth in metres."""

    patch: I32
    """Pixels along each side of a patch."""

    columns: I32
    """Patches in a row of the image."""

    @ti.func
    def at_pixel(self, u: I32, v: I32):
        """The noise of pixel (u, v)."""
        row = (v // self.patch) * self.columns + u // self.patch
        noise = PixelNoise(Vec5(0.0), Vec5(0.0))
        for term in ti.static(range(TERMS)):
            noise.sigma_terms[term] = self.coefficients[row, 0, term]
            noise.bias_terms[term] = self.coefficients[row, 1, term]
        return noise
