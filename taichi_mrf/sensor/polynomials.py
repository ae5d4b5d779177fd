"""Noise in kernels: polynomials of depth for each patch of pixels, and any noise whose sigma is scaled. How
noise plugs in: sensor/model.py."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from taichi_mrf.sensor.limits import LEAST_SIGMA_M, TERMS
from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, F32Array3, Struct, Template, Vec5

SAME_SIGMA = 2**0.5
"""Pixels whose sigmas differ by no more than about this factor may share a ray."""

LEVELS_IN_E = 1.0 / math.log(SAME_SIGMA)


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
        """Derivative of sigma by depth."""
        bounded = polynomial(self.sigma_terms, depth) <= LEAST_SIGMA_M
        return ti.select(bounded, 0.0, slope(self.sigma_terms, depth))

    @ti.func
    def bias_slope(self, depth: F32):
        """Derivative of the bias by depth."""
        return slope(self.bias_terms, depth)


@dataclass(frozen=True)
class ScaledPixelNoise(Bundle):
    """The noise of one pixel whose sigma is ``scale`` times that of ``noise``, and ``added`` metres."""

    noise: Template
    scale: F32
    added: F32

    @ti.func
    def sigma(self, depth: F32):
        """Standard deviation of the measurement of a surface at ``depth``, at least LEAST_SIGMA_M."""
        return ti.max(self.scale * self.noise.sigma(depth) + self.added, LEAST_SIGMA_M)

    @ti.func
    def bias(self, depth: F32):
        """Mean of measured minus true depth for a surface at ``depth``, in metres."""
        return self.noise.bias(depth)

    @ti.func
    def sigma_slope(self, depth: F32):
        """Derivative of sigma by depth."""
        bounded = self.scale * self.noise.sigma(depth) + self.added <= LEAST_SIGMA_M
        return ti.select(bounded, 0.0, self.scale * self.noise.sigma_slope(depth))

    @ti.func
    def bias_slope(self, depth: F32):
        """Derivative of the bias by depth."""
        return self.noise.bias_slope(depth)


class SensorNoise(Bundle):
    """The base of all noise in kernels."""

    at_pixel: ClassVar[Any]
    """A ti.func, as PolynomialTable has it. It returns an object with the methods of PixelNoise."""

    own_sigmas: ClassVar[bool] = False
    """True if pixels of one patch differ: then there is a ``sigma_level``."""

    sigma_level: ClassVar[Any]
    """A ti.func, as ScaledTable has it."""

    @ti.func
    def times(self, noise: Template, factor: F32):
        """The noise of a pixel, as :attr:`at_pixel` returns it, with ``factor`` times its sigma."""
        return ScaledPixelNoise(noise, factor, 0.0)


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

    @ti.func
    def times(self, noise: Template, factor: F32):
        """As SensorNoise has it, before sigma is bounded."""
        return PixelNoise(factor * noise.sigma_terms, noise.bias_terms)


@dataclass(frozen=True)
class ScaledTable(SensorNoise):
    """Any noise, with a factor of each pixel's sigma (noise.ScaledNoiseTable)."""

    own_sigmas: ClassVar[bool] = True

    noise: SensorNoise

    scale: F32Array
    """The factors of square patches of pixels, row by row."""

    patch: I32
    columns: I32
    """As in PolynomialTable; patches of one pixel if each has a factor of its own."""

    added: F32
    """Metres that are added to the scaled sigma."""

    @ti.func
    def factor(self, u: I32, v: I32):
        """The factor of pixel (u, v)."""
        return self.scale[(v // self.patch) * self.columns + u // self.patch]

    @ti.func
    def at_pixel(self, u: I32, v: I32):
        """The noise of pixel (u, v)."""
        noise = self.noise.at_pixel(u, v)
        scale = self.factor(u, v)
        return ScaledPixelNoise(noise, scale, self.added)

    @ti.func
    def times(self, noise: Template, factor: F32):
        """As SensorNoise has it."""
        within = self.noise.times(noise.noise, factor)
        return ScaledPixelNoise(within, noise.scale, factor * noise.added)

    @ti.func
    def sigma_level(self, u: I32, v: I32):
        """The power of SAME_SIGMA that is nearest to the factor of pixel (u, v), and that of its noise."""
        level = ti.cast(ti.round(ti.log(self.factor(u, v)) * LEVELS_IN_E), ti.i32)
        if ti.static(self.noise.own_sigmas):
            level += self.noise.sigma_level(u, v)
        return level
