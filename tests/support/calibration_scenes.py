"""Made-up depth with known noise: tilted planes that fill the view."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from taichi_mrf.calibration.pairs import DepthPair
from taichi_mrf.sensor.camera import PinholeCamera

CAMERA = PinholeCamera(width=160, height=120, fx=140, fy=142, cx=79.0, cy=60.5)


@dataclass(frozen=True)
class Tables:
    """Known noise: one row of ascending coefficients for each patch, as PatchNoise has them."""

    sigma: NDArray[np.float64]
    bias: NDArray[np.float64]
    patch: int

    def measured(
        self, true_m: NDArray[np.floating], random: np.random.Generator, least_sigma: float = 0.0
    ) -> NDArray[np.float32]:
        """Depth with this noise where there is depth, 0 elsewhere."""
        v, u = np.indices(true_m.shape)
        row = v // self.patch * -(-true_m.shape[1] // self.patch) + u // self.patch
        true = true_m.astype(np.float64)
        sigma = np.maximum(polyval(true, self.sigma.T[:, row], tensor=False), least_sigma)
        bias = polyval(true, self.bias.T[:, row], tensor=False)
        noisy = true + bias + sigma * random.standard_normal(true.shape)
        return np.where(true > 0, noisy, 0).astype(np.float32)


def random_tables(patches: int, patch: int, random: np.random.Generator) -> Tables:
    """Noise of about a stereo camera's size that differs from patch to patch by a few tenths."""
    sigma = np.array([0.002, 0.0005, 0.0025]) * (1 + 0.3 * random.uniform(-1, 1, (patches, 3)))
    bias = np.array([0.004, -0.006, 0.005]) * (1 + 0.5 * random.uniform(-1, 1, (patches, 3)))
    return Tables(sigma, bias, patch)


def plane_depth(camera: PinholeCamera, depth: float, tilt: Sequence[float]) -> NDArray[np.float32]:
    """Axial depth of a plane at ``depth`` on the optical axis; ``tilt`` is its slope along x and y."""
    rays = camera.rays()
    inverse = (1 - tilt[0] * rays[..., 0] - tilt[1] * rays[..., 1]) / depth
    return np.where(inverse > 0, 1 / np.maximum(inverse, 1e-6), 0).astype(np.float32)


class Planes:
    """A source of pairs: planes from ``nearest`` to ``furthest``, tilted at random, measured with noise.

    The same pair comes again when it is read again, as from a file.
    """

    def __init__(
        self,
        tables: Tables,
        count: int,
        nearest: float,
        furthest: float,
        camera: PinholeCamera = CAMERA,
        seed: int = 0,
        least_sigma: float = 0.0,
    ) -> None:
        self.names = [f"{k:04d}" for k in range(count)]
        self._tables, self._camera, self._seed, self._least_sigma = tables, camera, seed, least_sigma
        self._depths = np.linspace(nearest, furthest, count)

    def read(self, name: str) -> DepthPair:
        random = np.random.default_rng([self._seed, int(name)])
        true_m = plane_depth(self._camera, self._depths[int(name)], random.uniform(-0.3, 0.3, 2))
        return DepthPair(name, self._tables.measured(true_m, random, self._least_sigma), true_m)
