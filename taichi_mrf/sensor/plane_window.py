"""Neighbouring pixels measure one surface: what the plane through their measurements says of each of them.

A voxel that is smaller than sigma meets few rays of an image, while errors of single pixels average out over
those around. Seen by a camera, a plane's inverse depth is an affine function of the pixel. In a square window
of n pixels around each pixel

    1 / z_j = a + b (u_j - u) + c (v_j - v) + e_j,     weights  w_j = (z_j^2 / sigma_j)^2

is solved by least squares, with z_j the measurements without their bias, and the pixel's measurement becomes
that of a surface at 1 / a. How much of the noise has averaged out is seen in the image itself:

    chi   = sum_j w_j e_j^2 / (n - 3)                            1 if all of sigma is independent
    sigma'^2 = sigma^2 (1 - min(chi, 1) (1 - 1 / n))             and at least LEAST^2 sigma^2

Errors that the window shares, such as those of the pose, of the bias, or of a smoothing sensor, do not show
in chi, and stay in sigma'. A window that holds no plane (an edge, a curve) is halved until one does.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseTable, without_bias
from taichi_mrf.sensor.pixel_sigma import ScaledNoiseTable

Image = NDArray[np.float64]

MOST_REACH = 8
"""Pixels to each side of the window, at most."""

LEAST = 0.5
"""Sigma falls to no less than this share of the sensor's: noise files and poses are never quite right."""

MOST_CHI = 1.5
"""A window whose measurements differ from a plane by more than this share of their variance holds none."""

MOST_SIGMAS = 3.0
"""A measurement that lies further from the plane is not of it."""

LEAST_SHARE = 0.5
"""Share of the window's pixels that have to hold a measurement. Half of a square is more than one line of it,
so that its plane is determined."""


@dataclass(frozen=True)
class PlaneWindow:
    """The windows of an image, in metres: ``half_side_m`` is half their side at the surface. Pixels whose
    sigma is ``least_sigma_m`` or less stay as they are: voxels of that size do not tell the difference, and
    what else may be wrong (poses) counts for more."""

    half_side_m: float
    least_sigma_m: float


def averaged_on_planes(
    depth_m: NDArray[np.float32], camera: Camera, table: NoiseTable, window: PlaneWindow
) -> tuple[NDArray[np.float32], NoiseTable]:
    """Depth (H, W), 0 where none, with each measurement replaced by that of the plane around it, and their
    noise.

    Pixels whose window holds no plane keep depth and noise. Cameras whose pixels have no pattern keep all.
    Raises ConfigError if the noise is not made of polynomials.
    """
    if not isinstance(table, NoiseTable):
        raise ConfigError(
            "inference.plane_window needs noise made of polynomials, which that of this keyframe is not: "
            "leave it 0, or add the keyframe with noise=PolynomialNoise(...)"
        )
    scale = np.ones(camera.shape, np.float32)
    if camera.pixels_per_radian > 0:
        z = without_bias(depth_m, table)
        sigma = table.at_pixels(z)[0]
        reach = np.where(sigma > window.least_sigma_m, _reach(z, camera, window.half_side_m), 0)
        flat, scale = _on_planes(z, sigma, reach)
        moved = flat != z
        bias = [table.at_pixels(each)[1] for each in (z, flat)]
        there = depth_m + (flat - z) + (bias[1] - bias[0])
        depth_m = np.where(moved & (there > 0), there, depth_m).astype(np.float32)
    if isinstance(table, ScaledNoiseTable):
        scale = scale * table.scale
    return depth_m, ScaledNoiseTable(table.coefficients, table.patch, table.columns, scale)


def _reach(z: Image, camera: Camera, half_side_m: float) -> NDArray[np.int32]:
    """Pixels to each side of each pixel's window."""
    wide = half_side_m * camera.pixels_per_radian / np.where(z > 0, z, np.inf)
    return np.minimum(np.rint(wide), MOST_REACH).astype(np.int32)


def _on_planes(z: Image, sigma: Image, reach: NDArray[np.int32]) -> tuple[Image, NDArray[np.float32]]:
    """``z`` on the plane of each pixel's window, and the factor on its sigma; unchanged where it has none."""
    measured = z > 0
    if not (measured & (reach > 0)).any():
        return z, np.ones(z.shape, np.float32)
    known = np.where(measured, z, 1.0)
    sums = _Sums(1.0 / known, np.where(measured, (known**2 / sigma) ** 2, 0.0))
    flat, scale = z.copy(), np.ones(z.shape, np.float32)
    rows, columns = np.nonzero(measured & (reach > 0))
    wide = reach[rows, columns]
    while len(rows):
        inverse, share = sums.plane(rows, columns, wide)
        found = np.isfinite(inverse)
        at = rows[found], columns[found]
        flat[at] = 1.0 / inverse[found]
        scale[at] = share[found]
        again = ~found & (wide > 1)
        rows, columns, wide = rows[again], columns[again], wide[again] // 2
    return flat, scale


class _Sums:
    """Sums over any window of an image in constant time: of weights, places, inverse depths and products,
    added up from the image's corner."""

    def __init__(self, inverse: Image, weight: Image) -> None:
        """``inverse`` depth and ``weight``, (H, W); the weight is 0 where nothing was measured."""
        self.inverse, self.weight = inverse, weight
        height, width = inverse.shape
        v, u = np.mgrid[:height, :width] - 0.5 * np.array([height, width])[:, None, None]
        self.u, self.v = u, v
        q = inverse
        wu, wv, wq = weight * u, weight * v, weight * q
        parts = (
            (weight > 0).astype(np.float64), weight, wu, wv, wq,
            wu * u, wu * v, wv * v, wu * q, wv * q, wq * q,
        )  # fmt: skip
        self.sums = np.stack([cv2.integral(part, sdepth=cv2.CV_64F) for part in parts], axis=-1)

    def plane(
        self, rows: NDArray[np.int64], columns: NDArray[np.int64], reach: NDArray[np.int32]
    ) -> tuple[Image, NDArray[np.float32]]:
        """Of pixels (n,) with windows of ``reach`` pixels to each side: the inverse depth of the plane there,
        NaN if the window holds none, and the factor on sigma."""
        height, width = self.weight.shape
        top, bottom = np.maximum(rows - reach, 0), np.minimum(rows + reach + 1, height)
        left, right = np.maximum(columns - reach, 0), np.minimum(columns + reach + 1, width)
        s = self.sums
        window = s[bottom, right] - s[top, right] - s[bottom, left] + s[top, left]
        n, w, su, sv, sq, suu, suv, svv, squ, sqv, sqq = window.T
        with np.errstate(divide="ignore", invalid="ignore"):  # in windows of too few pixels
            u, v, q = su / w, sv / w, sq / w
            uu, uv, vv = suu / w - u * u, suv / w - u * v, svv / w - v * v
            qu, qv = squ / w - q * u, sqv / w - q * v
            determinant = uu * vv - uv * uv
            b, c = (qu * vv - qv * uv) / determinant, (qv * uu - qu * uv) / determinant
            inverse = q + b * (self.u[rows, columns] - u) + c * (self.v[rows, columns] - v)
            rest = np.maximum(sqq / w - q * q - (b * qu + c * qv), 0.0)
            chi = rest * w / np.maximum(n - 3.0, 1.0)
            here = np.sqrt(self.weight[rows, columns])
        found = (n >= LEAST_SHARE * (2.0 * reach + 1.0) ** 2) & (chi < MOST_CHI) & (inverse > 0)
        found &= np.abs(inverse - self.inverse[rows, columns]) * here < MOST_SIGMAS
        shared = 1.0 - np.minimum(chi, 1.0) * (1.0 - 1.0 / np.maximum(n, 1.0))
        return np.where(found, inverse, np.nan), np.sqrt(np.maximum(shared, LEAST**2)).astype(np.float32)
