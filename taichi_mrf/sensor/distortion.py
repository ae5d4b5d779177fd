"""A pinhole camera with lens distortion, by OpenCV's model: each pixel's ray is undistorted once."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.stored import Arrays

_COEFFICIENTS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV takes."""

_STEPS = 200
"""Most steps of the iteration that undistorts."""

_CLOSE_PX = 1e-4
"""A ray must be projected to its pixel again as nearly as this."""


class DistortedCamera(RayTable):
    """A pinhole camera with lens distortion (camera.Camera). Depth is axial. Rays between pixels are
    interpolated linearly. Otherwise it is a ray table, and equals the table with the same rays."""

    def __init__(self, pinhole: PinholeCamera, coefficients: ArrayLike) -> None:
        """``coefficients`` are OpenCV's k1, k2, p1, p2, k3 and so on, 4, 5, 8, 12 or 14 of them.

        Raises ConfigError for another number, for values that are not finite, and if the distortion folds the
        image, so that a pixel has no ray.
        """
        k = array(coefficients, "distortion coefficients").reshape(-1)
        if len(k) not in _COEFFICIENTS or not np.isfinite(k).all():
            numbers = ", ".join(map(str, _COEFFICIENTS))
            raise ConfigError(f"a distortion has {numbers} finite coefficients, not {k.tolist()}")
        self.pinhole, self._coefficients = pinhole, k.copy()
        matrix = np.array([[pinhole.fx, 0, pinhole.cx], [0, pinhole.fy, pinhole.cy], [0, 0, 1.0]])
        v, u = np.indices(pinhole.shape)
        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
        rays, off = pinhole.rays().reshape(-1, 1, 3), np.full(pixels.shape, np.inf)
        left = np.arange(len(pixels))
        with np.errstate(all="ignore"):
            # cv2.undistortPoints stops after five of these steps.
            rays[..., :2] = cv2.undistortPoints(pixels, matrix, k)
            for _ in range(_STEPS):
                seen = cv2.projectPoints(rays[left], np.zeros(3), np.zeros(3), matrix, k)[0]
                off[left] = pixels[left] - seen.reshape(-1, 1, 2)
                left = left[~(np.abs(off[left]).max(axis=(1, 2)) <= _CLOSE_PX)]
                if not len(left):
                    break
                rays[left, :, :2] += off[left] / (pinhole.fx, pinhole.fy)
        found = rays.reshape(*pinhole.shape, 3)
        wrong = ~(np.abs(off).max(axis=(1, 2)) <= _CLOSE_PX).reshape(pinhole.shape)
        # Other pixels have the ray where the image is folded.
        wrong[:, 1:] |= np.diff(found[..., 0], axis=1) <= 0
        wrong[1:] |= np.diff(found[..., 1], axis=0) <= 0
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            raise ConfigError(f"the distortion {k.tolist()} gives column {column}, row {row} no ray")
        super().__init__(found)

    @property
    def coefficients(self) -> NDArray[np.float64]:
        """OpenCV's coefficients, as they were given."""
        return self._coefficients.copy()

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {**self.pinhole.arrays(), "distortion": self._coefficients}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "DistortedCamera":
        return cls(PinholeCamera.of_arrays(file), file.array("distortion", "f", (None,)))

    def __reduce__(self) -> tuple[Any, ...]:
        return DistortedCamera, (self.pinhole, self._coefficients)
