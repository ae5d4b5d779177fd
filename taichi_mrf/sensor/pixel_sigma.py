"""A sigma for each pixel, in place of a noise model's.

It holds at the measured depth. At other depths sigma changes as the model's does: the model's sigma of a
pixel is multiplied by one factor, so that the law of the sensor (such as the square of depth for stereo)
stays. The bias is the model's.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.limits import LEAST_SIGMA_M
from taichi_mrf.sensor.noise import NoiseModel, NoiseTable

if TYPE_CHECKING:
    from taichi_mrf.sensor.polynomials import SensorNoise


@dataclass(frozen=True)
class ScaledNoiseTable(NoiseTable):
    """Polynomials whose sigma is multiplied by ``scale``, (H, W) float32."""

    scale: NDArray[np.float32]

    def at_pixels(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        sigma, bias = super().at_pixels(depth_m)
        return np.maximum(sigma * self.scale, LEAST_SIGMA_M), bias

    def largest(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        sigma, bias = super().largest(depth_m)
        return np.maximum(sigma * float(self.scale.max(initial=1.0)), LEAST_SIGMA_M), bias

    def in_kernels(self) -> "SensorNoise":
        """The table as kernels take it: a polynomials.ScaledTable."""
        from taichi_mrf.kernels.resident import resident
        from taichi_mrf.sensor.polynomials import ScaledTable

        parts = resident(self.coefficients), self.patch, self.columns
        return ScaledTable(*parts, resident(self.scale.reshape(-1)), self.scale.shape[1])


@dataclass(frozen=True)
class PixelSigma:
    """The noise of one depth image (H, W): a noise model, and ``sigma_m`` (H, W) where that is above 0."""

    noise: NoiseModel
    sigma_m: NDArray[np.float32]
    depth_m: NDArray[np.floating]

    def table(self, camera: Camera) -> NoiseTable:
        """The noise of the image's pixels. Raises ConfigError if the model does not fit the camera, or is not
        made of polynomials."""
        table = self.noise.table(camera)
        if not isinstance(table, NoiseTable):
            raise ConfigError(
                f"sigma_m needs polynomial noise, not {type(self.noise).__name__}: leave "
                "out sigma_m, or add the keyframe with noise=PolynomialNoise(...)"
            )
        stated = (self.sigma_m > 0) & np.isfinite(self.sigma_m) & (self.depth_m > 0)
        model, _ = table.at_pixels(np.where(stated, self.depth_m, 0.0))
        scale = np.where(stated, self.sigma_m / model, 1.0).astype(np.float32)
        return ScaledNoiseTable(table.coefficients, table.patch, table.columns, scale)
