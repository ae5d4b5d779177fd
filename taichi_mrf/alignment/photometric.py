"""Residuals of colour, and their derivatives by the camera's pose.

A point p of the camera frame, of which a keyframe saw the contrast c, is seen by the image I at pixel pi(p).
Where the camera is moved by T exp(xi), xi = (rho, omega), p moves by -rho - omega x p, and with the slope of
the image by the point, a = (dI / dpi) (dpi / dp),

    r = I(pi(p)) - c        dr / dxi = (-a, a x p)

Residuals count by Tukey's biweight, in units of sigma, their own spread. Thousands of pixels err together, as
the two cameras are no perfect pinholes and not started at the same moment: together they count no more than
one measurement of each direction with the standard deviation COLOR_SIGMA_RAD.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.contrast import LARGEST_JUMP, ContrastImage, TexturedPoints
from taichi_mrf.alignment.point_to_plane import LARGEST_COST, TUKEY
from taichi_mrf.geometry.poses import Pose

COLOR_SIGMA_RAD = 5e-4
"""Sigma of the alignment of two pictures, in radians."""

LEAST_POINTS = 20
"""Fewer points in the picture tell nothing."""

ENOUGH_POINTS = 200
"""With fewer, colour counts by the share of this number that there are."""

TILES = 8
"""The image is divided into this many times as many tiles, to see how far the points are spread."""

LEAST_SPREAD, ENOUGH_SPREAD = 0.45, 0.65
"""Share of the tiles that hold a point, up to which colour does not count, and from which on it does in full.
Few lines on bare walls, which may be edges of shadows, must not move the camera."""

LEAST_SIGMA, LARGEST_SIGMA = 0.02, 0.1
"""Bounds on the sigma of the contrast. Where residuals spread further, the pictures do not show the same."""


@dataclass(frozen=True)
class ColorEquations:
    """A least-squares problem around one pose: ``H`` (6, 6) and ``g`` (6,) of the step xi with H xi = -g, and
    the ``cost`` there, weighted as they count beside depth."""

    H: NDArray[np.float64]
    g: NDArray[np.float64]
    cost: float


NO_COLOR = ColorEquations(np.zeros((6, 6)), np.zeros(6), 0.0)
"""The equations of pictures that tell nothing."""


class Photometric:
    """The residuals of points of the world, ``points`` (N, 3) metres with ``contrast`` (N,), in an image, for
    one pose after the other. The ``sigma`` and the weight of all together (``worth``) stay."""

    def __init__(
        self,
        image: ContrastImage,
        points: NDArray[np.float64],
        contrast: NDArray[np.float64],
        sigma: float,
        worth: float = 1.0,
    ) -> None:
        self.sigma, self.worth = sigma, worth
        self._image, self._points, self._contrast = image, points, contrast

    @staticmethod
    def seen_from(image: ContrastImage, points: TexturedPoints, T_world_camera: Pose) -> "Photometric | None":
        """The residuals of those points of the world that the image shows if it was taken at a pose; None if
        there are too few."""
        world = points.points.astype(np.float64)
        _, uv, seen = _projected(image, world, T_world_camera)
        rows = np.flatnonzero(seen)
        if len(rows) < LEAST_POINTS:
            return None
        contrast = points.contrast[rows].astype(np.float64)
        spread = 1.4826 * float(np.median(np.abs(_sampled(image, uv[rows])[0] - contrast)))
        sigma = float(np.clip(spread, LEAST_SIGMA, LARGEST_SIGMA))
        found = Photometric(image, world[rows], contrast, sigma)
        found.worth = _spread(image, uv[rows]) * found._worth(T_world_camera)
        return found

    def linearised(self, T_world_camera: Pose) -> ColorEquations:
        """Residuals and their derivatives at a pose. A point that the image does not show there costs as much
        as one that looks different."""
        r, inside, J = self._residuals(T_world_camera)
        weighted = (inside**2 / self.sigma**2)[:, None] * J
        cost = LARGEST_COST * (float((1 - inside**3).sum()) + len(self._points) - len(r))
        return ColorEquations(self.worth * J.T @ weighted, self.worth * weighted.T @ r, self.worth * cost)

    def _residuals(
        self, T_world_camera: Pose
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Of the points that are seen from a pose: the residual (n,), 1 - (r / (TUKEY sigma))^2 or 0 beyond
        that (n,), and dr / dxi (n, 6)."""
        camera = self._image.camera
        p, uv, seen = _projected(self._image, self._points, T_world_camera)
        p, uv = p[seen], uv[seen]
        contrast, slopes = _sampled(self._image, uv)
        r = contrast - self._contrast[seen]
        inside = np.maximum(0.0, 1 - (r / (TUKEY * self.sigma)) ** 2)
        du, dv = slopes[:, 0] * camera.fx, slopes[:, 1] * camera.fy
        a = np.stack([du, dv, -(du * p[:, 0] + dv * p[:, 1]) / p[:, 2]], axis=1) / p[:, 2:]
        return r, inside, np.concatenate([-a, np.cross(a, p)], axis=1)

    def _worth(self, T_world_camera: Pose) -> float:
        """The factor that turns all points into one measurement, less where few of them look alike."""
        _, inside, J = self._residuals(T_world_camera)
        # A turn by a small angle about either axis across the view moves the picture by that angle.
        slopes = float((inside**2 / self.sigma**2) @ (J[:, 3:5] ** 2).sum(axis=1))
        if slopes <= 0:
            return 0.0
        alike = float((inside > 0).mean()) * min(1.0, len(self._points) / ENOUGH_POINTS)
        return alike / (slopes * COLOR_SIGMA_RAD**2)


def _projected(
    image: ContrastImage, world: NDArray[np.float64], T_world_camera: Pose
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Points (N, 3) of the world in the camera frame (N, 3), their column and row (N, 2), and which of them
    the image shows: not those behind what it has measured."""
    p = (world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    camera = image.camera
    ahead = np.maximum(p[:, 2], 1e-3)
    uv = np.stack([camera.fx * p[:, 0] / ahead + camera.cx, camera.fy * p[:, 1] / ahead + camera.cy], axis=1)
    seen = (p[:, 2] > 1e-3) & (uv >= 1).all(axis=1) & (uv < (camera.width - 2, camera.height - 2)).all(axis=1)
    u, v = np.where(seen[:, None], uv, 1).round().astype(np.intp).T
    depth_m = image.depth_m[v, u]
    seen &= image.usable[v, u] & ((depth_m == 0) | (np.abs(depth_m - ahead) < LARGEST_JUMP * ahead))
    return p, uv, seen


def _spread(image: ContrastImage, uv: NDArray[np.float64]) -> float:
    """Spread of points at columns and rows (N, 2) over the image, from 0 to 1."""
    tiles = (uv * TILES / (image.camera.width, image.camera.height)).astype(np.intp)
    share = len(np.unique(tiles @ (TILES, 1))) / TILES**2
    return float(np.clip((share - LEAST_SPREAD) / (ENOUGH_SPREAD - LEAST_SPREAD), 0, 1))


def _sampled(
    image: ContrastImage, uv: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Contrast (N,) and slopes (N, 2) between pixels, (N, 2) columns and rows inside the image."""
    whole = np.floor(uv).astype(np.intp)
    (u, v), (right, down) = whole.T, (uv - whole).T
    contrast, slopes = np.zeros(len(uv)), np.zeros((len(uv), 2))
    for y, x in np.ndindex(2, 2):
        weight = (down if y else 1 - down) * (right if x else 1 - right)
        contrast += weight * image.contrast[v + y, u + x]
        slopes += weight[:, None] * image.slopes[v + y, u + x]
    return contrast, slopes
