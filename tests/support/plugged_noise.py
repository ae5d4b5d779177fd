"""A sigma for each pixel, one of squared depth, and another law of measurements, as plugs from outside."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import Curves, StoredNoise
from taichi_mrf.sensor.polynomials import SensorNoise
from taichi_mrf.sensor.stored import Arrays
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.resident import resident
from taichi_mrf.system.types import F32, I32, F32Array, Struct, Template

# ruff: noqa: ANN201, ANN202 - Taichi does not allow `-> None` on a kernel or a func.


@ti.dataclass
class _Sigma(Struct):
    """A pixel's own sigma, at every depth, and no bias."""

    value: F32

    @ti.func
    def sigma(self, depth: F32):
        return self.value

    @ti.func
    def bias(self, depth: F32):
        return 0.0

    @ti.func
    def sigma_slope(self, depth: F32):
        return 0.0

    @ti.func
    def bias_slope(self, depth: F32):
        return 0.0


@dataclass(frozen=True)
class PixelSigmas(SensorNoise):
    """``sigma_m`` (H * W), metres."""

    sigma_m: F32Array
    width: I32

    @ti.func
    def at_pixel(self, u: I32, v: I32):
        return _Sigma(self.sigma_m[v * self.width + u])


@dataclass(frozen=True)
class PixelNoise(StoredNoise):
    """A noise model with a sigma for each pixel, (H, W) metres, and perhaps another law of measurements."""

    sigma_m: NDArray[np.float32]
    law: type[Sensor] = Sensor

    def table(self, camera: Any) -> "PixelNoise":
        return self

    def at_pixels(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self.sigma_m.astype(np.float64), np.zeros(self.sigma_m.shape)

    def largest(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.full(depth_m.size, float(self.sigma_m.max())), np.zeros(depth_m.size)

    def sensor(self, camera: Any) -> Sensor:
        sigmas = PixelSigmas(resident(self.sigma_m.reshape(-1)), camera.width)
        return self.law(camera.in_kernels(), sigmas)

    def curves(self, depth_m: NDArray[np.float64]) -> Curves:
        sigma = np.repeat(self.sigma_m.reshape(-1, 1).astype(np.float64), depth_m.size, axis=1)
        return sigma, np.zeros(sigma.shape)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"sigma_m": self.sigma_m}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "PixelNoise":
        return cls(file.array("sigma_m", "f", (None, None)))


@ti.dataclass
class _SquareSigma(Struct):
    """The noise of all pixels of a stereo camera."""

    least: F32
    growth: F32
    offset: F32

    @ti.func
    def sigma(self, depth: F32):
        return self.least + self.growth * depth * depth

    @ti.func
    def bias(self, depth: F32):
        return self.offset

    @ti.func
    def sigma_slope(self, depth: F32):
        return 2.0 * self.growth * depth

    @ti.func
    def bias_slope(self, depth: F32):
        return 0.0


@dataclass(frozen=True)
class SquareSigmas(SensorNoise):
    """One law for all pixels."""

    least: F32
    growth: F32
    offset: F32

    @ti.func
    def at_pixel(self, u: I32, v: I32):
        return _SquareSigma(self.least, self.growth, self.offset)


@dataclass(frozen=True)
class SquareNoise(StoredNoise):
    """sigma = least_m + growth * depth^2 and a bias of offset_m, as PolynomialNoise((least_m, 0, growth),
    (offset_m,)) has them, by a class that holds no polynomials."""

    least_m: float
    growth: float
    offset_m: float = 0.0

    def table(self, camera: Any) -> "SquareNoise":
        return self

    def at_pixels(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        depth = depth_m.astype(np.float64)
        return self.least_m + self.growth * depth * depth, np.full(depth.shape, self.offset_m)

    def largest(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        sigma, bias = self.at_pixels(depth_m)
        return sigma, np.abs(bias)

    def sensor(self, camera: Any) -> Sensor:
        return Sensor(camera.in_kernels(), SquareSigmas(self.least_m, self.growth, self.offset_m))

    def curves(self, depth_m: NDArray[np.float64]) -> Curves:
        sigma, bias = self.at_pixels(depth_m)
        return sigma[None], bias[None]

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"square": np.array([self.least_m, self.growth, self.offset_m])}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "SquareNoise":
        return cls(*file.array("square", "f", (3,)).tolist())


@dataclass(frozen=True)
class UniformLaw(Sensor):
    """Measurements lie anywhere within two sigmas of the surface."""

    @ti.func
    def likelihood(
        self, measured: F32, near: F32, far: F32, noise: Template, voxel_size: F32, mode: Template
    ):
        half = 2.0 * noise.sigma(measured)
        inside = ti.max(0.0, ti.min(far, measured + half) - ti.max(near, measured - half))
        return inside / ti.max(far - near, 1e-6) / (2.0 * half)
