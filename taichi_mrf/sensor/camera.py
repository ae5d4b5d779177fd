"""The pinhole camera: how pixels become rays."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.arguments import instance, real, whole
from taichi_mrf.errors import ConfigError

_NO_SKEW = 1e-6
"""Entries of a camera matrix below this share of fx come from rounding."""


@dataclass(frozen=True)
class PinholeCamera:
    """An undistorted pinhole camera; all lengths in pixels.

    The ray of pixel (u, v) (column, row) goes through the pixel's centre, which has the coordinates
    (u, v): the principal point of a camera with W columns that looks straight ahead is (W - 1) / 2.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            whole(getattr(self, name), f"camera {name}", least=1)
        for name in ("fx", "fy", "cx", "cy"):
            real(getattr(self, name), f"camera {name}")
        for name in ("fx", "fy", "cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise ConfigError(f"camera {name} is not finite")
        if self.fx <= 0 or self.fy <= 0:
            raise ConfigError(f"camera focal lengths {self.fx}, {self.fy}: both must be positive")

    @classmethod
    def from_matrix(cls, width: int, height: int, K: NDArray[np.floating]) -> "PinholeCamera":
        """The camera of a matrix (3, 3), fx 0 cx / 0 fy cy / 0 0 1. Raises ConfigError for one with skew or
        of another form."""
        fx = float(K[0, 0])
        if abs(K[0, 1]) > _NO_SKEW * abs(fx):
            raise ConfigError(f"the matrix has skew {K[0, 1]:g}; only cameras without skew can be used")
        if abs(K[1, 0]) > _NO_SKEW * abs(fx) or np.abs(K[2] - (0.0, 0.0, 1.0)).max() > _NO_SKEW:
            raise ConfigError("not the matrix of a pinhole camera: fx 0 cx / 0 fy cy / 0 0 1")
        return cls(width, height, fx, float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of this camera's images."""
        return self.height, self.width

    def scaled(self, factor: float) -> "PinholeCamera":
        """The same view with ``factor`` times as many pixels along each side."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def rays(self) -> NDArray[np.float64]:
        """Directions of all pixels in the camera frame, (H, W, 3), with z = 1.

        A ray's parameter along these is axial depth; times ``range_per_depth`` it is Euclidean range.
        """
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(self.shape)], axis=-1)

    def range_per_depth(self) -> NDArray[np.float64]:
        """Euclidean range of each pixel's ray for one metre of axial depth, (H, W), at least 1."""
        return np.linalg.norm(self.rays(), axis=-1)

    def largest_slant(self) -> float:
        """The largest entry of :meth:`range_per_depth`, which belongs to a corner of the image."""
        x = max(abs(self.cx), abs(self.width - 1 - self.cx)) / self.fx
        y = max(abs(self.cy), abs(self.height - 1 - self.cy)) / self.fy
        return math.hypot(1.0, x, y)


def check_camera(camera: object) -> None:
    """Raise ArgumentTypeError for an argument ``camera`` that is none."""
    instance(camera, PinholeCamera, "camera", "a PinholeCamera")
