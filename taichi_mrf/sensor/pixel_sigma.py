"""A sigma for each pixel, in place of a noise model's.

It holds at the measured depth. At other depths sigma changes as the model's does: the model's sigma of a
pixel is multiplied by one factor, so that the law of the sensor (such as the square of depth for stereo)
stays. The bias is the model's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import CameraNoise, NoiseModel, ScaledNoiseTable


def sigma_to_scale(table: CameraNoise, depth_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """The sigma (H, W) of measurements, 1 where there is none. Raises ConfigError if a factor on it has no
    meaning: it must be above 0 and finite."""
    sigma = np.where(depth_m > 0, table.at_pixels(depth_m)[0], 1.0)
    wrong = ~(np.isfinite(sigma) & (sigma > 0))
    if wrong.any():
        raise ConfigError(
            f"the sigma of {np.count_nonzero(wrong)} pixels cannot be scaled: it is {sigma[wrong][0]:g} m at "
            f"a depth of {depth_m[wrong][0]:.3g} m; let at_pixels of {type(table).__name__} return finite "
            "values above 0, or leave out sigma_m and pose_covariance"
        )
    return sigma


@dataclass(frozen=True)
class PixelSigma:
    """The noise of one depth image (H, W): a noise model, and ``sigma_m`` (H, W) where that is above 0."""

    noise: NoiseModel
    sigma_m: NDArray[np.float32]
    depth_m: NDArray[np.floating]

    def table(self, camera: Camera) -> ScaledNoiseTable:
        """The noise of the image's pixels. Raises ConfigError if the model does not fit the camera, or if its
        sigma cannot be scaled."""
        table = self.noise.table(camera)
        stated = (self.sigma_m > 0) & np.isfinite(self.sigma_m) & (self.depth_m > 0)
        model = sigma_to_scale(table, np.where(stated, self.depth_m, 0.0))
        scale = np.where(stated, self.sigma_m / model, 1.0).astype(np.float32)
        return ScaledNoiseTable(table, scale, 0.0)
