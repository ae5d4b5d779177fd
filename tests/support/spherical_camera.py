"""A second kind of camera, a sigma for each pixel, and another law of measurements, as plugs from outside."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.kernels.resident import resident
from taichi_mrf.kernels.types import F32, I32, F32Array, Struct, Template, Vec3
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.polynomials import SensorNoise
from taichi_mrf.sensor.rays import CameraRays

# ruff: noqa: ANN201, ANN202 - Taichi does not allow `-> None` on a kernel or a func.


@dataclass(frozen=True)
class SphericalRays(CameraRays):
    """Unit directions, so depth is range. Columns are azimuths, rows elevations."""

    turn: F32  # radians from column to column
    top: F32  # elevation of row 0
    step: F32  # radians from row to row, downwards

    @ti.func
    def direction(self, u: F32, v: F32):
        azimuth, elevation = (u + 0.5) * self.turn - math.pi, self.top - v * self.step
        level = ti.cos(elevation)
        return Vec3(ti.sin(azimuth) * level, -ti.sin(elevation), ti.cos(azimuth) * level)

    @ti.func
    def plane(self, u: F32, v: F32, along_u: F32, along_v: F32, inverse: F32):
        azimuth, elevation = (u + 0.5) * self.turn - math.pi, self.top - v * self.step
        sideways = Vec3(ti.cos(azimuth), 0.0, -ti.sin(azimuth))
        up = Vec3(
            -ti.sin(azimuth) * ti.sin(elevation), -ti.cos(elevation), -ti.cos(azimuth) * ti.sin(elevation)
        )
        slope = along_u / (self.turn * ti.cos(elevation))
        return inverse * self.direction(u, v) + slope * sideways - along_v / self.step * up


@dataclass(frozen=True)
class SphericalCamera:
    """All azimuths, and elevations from -``reach`` to ``reach`` radians (taichi_mrf.sensor.camera.Camera)."""

    width: int
    height: int
    reach: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.height, self.width

    @property
    def turn(self) -> float:
        return 2 * math.pi / self.width

    @property
    def step(self) -> float:
        return 2 * self.reach / (self.height - 1)

    @property
    def pixels_per_radian(self) -> float:
        return min(1 / self.turn, 1 / self.step)

    def directions(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        azimuth, elevation = np.broadcast_arrays(
            (np.asarray(u) + 0.5) * self.turn - np.pi, self.reach - np.asarray(v) * self.step
        )
        level = np.cos(elevation)
        return np.stack([np.sin(azimuth) * level, -np.sin(elevation), np.cos(azimuth) * level], axis=-1)

    def rays(self) -> NDArray[np.float64]:
        return self.directions(np.arange(self.width)[None, :], np.arange(self.height)[:, None])

    def tile_hulls(self, tile: int) -> NDArray[np.float64]:
        """The cube around the unit sphere, for every tile."""
        cube = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
        return np.broadcast_to(cube, (-(-self.height // tile), -(-self.width // tile), 8, 3))

    def most_pixels_in_cone(self, half_angle: float, block: int) -> float:
        rows = min(self.height, 2 * half_angle / self.step + 1)
        columns = float(self.width)
        if half_angle + self.reach < 0.5 * math.pi:
            sideways = math.asin(min(1.0, math.sin(half_angle) / math.cos(self.reach)))
            columns = min(columns, 2 * sideways / self.turn + 1)
        return (rows + 2 * block) * (columns + 2 * block)

    def in_kernels(self) -> SphericalRays:
        return SphericalRays(self.width, self.turn, self.reach, self.step)


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
class PixelNoise:
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
