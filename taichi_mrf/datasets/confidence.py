"""Images of confidence that sensors give beside depth: what their levels mean, as a sigma for each pixel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.own_evidence import sigma_of_confidence


@dataclass(frozen=True)
class Confidence:
    """Levels from 0, no measurement, to ``top_level``, which stands for the ``sigma``, coefficients in
    ascending powers of depth; half the level doubles it. ``origin`` is where that comes from."""

    top_level: int
    sigma: tuple[float, ...]
    origin: str

    def sigma_m(
        self, levels: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera
    ) -> NDArray[np.float32]:
        """The sigma of each pixel of a depth image (H, W) from an image of its levels. Raises DatasetError,
        which names no file, for another size and for higher levels."""
        highest = levels.max(initial=0)
        if levels.shape != depth_m.shape or highest > self.top_level:
            raise DatasetError(
                f"has {levels.shape[1]} x {levels.shape[0]} pixels with levels up to {highest}; "
                f"expected {camera.width} x {camera.height} and at most {self.top_level}"
            )
        return sigma_of_confidence(levels / self.top_level, depth_m, PolynomialNoise(self.sigma), camera)


ARKIT = Confidence(top_level=2, sigma=(0.01,), origin="assumed for a phone's lidar")
"""Levels 0 to 2. Luetzenburg, Kroon and Bjork (Scientific Reports, 2021) found errors of 1 cm."""

L515 = Confidence(top_level=15, sigma=(0.0037, 0.0019), origin="assumed for an L515")
"""Grades of 4 bits. Intel gives an error of 5 mm and a standard deviation of 2.5 mm at 1 m, 14 mm and 15.5 mm
at 9 m; sigma is the root of their squares' sum there, and linear between."""
