"""Effect of an uncertain keyframe pose on its rays: a sigma of depth, and pixels to leave out.

A motion of the camera by a small twist xi = (rho, omega) moves a point p that it has measured by
rho + omega x p. Around p the surface is a plane, n . q = 1. The ray d of the pixel, kept where the recorded
pose has it, then meets this plane not at the depth z, but at

    z + g . xi     with  g = (n, p x n) / (n . d)

A covariance C of xi thus gives this depth the variance g' C g: of the motion along the ray, and of the motion
across it times the tangent of the incidence. It is added to that of the sensor.

Beside the edge of a nearer surface the ray may meet that one instead, which no sigma describes. A motion
across the ray by one standard deviation decides which pixels are left out.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import CameraNoise, NoiseModel, ScaledNoiseTable
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.pixel_sigma import sigma_to_scale

Covariance = NDArray[np.float64]
Image = NDArray[np.float64]

WINDOW = 0.014
"""Half the side of the square of pixels that a plane is fitted to, in radians: 8 pixels of a camera of 640 x
480."""

MOST_STEPS = 4
"""A wider square than this many pixels to each side is looked at in wider steps."""

STEEPEST = 0.2
"""Cosine of the incidence (78 degrees) up to which depth follows a motion across the ray. Planes at the edges
of surfaces are steeper, and mean nothing."""

FLATTEST = 1e-13
"""Determinant of a window's moments, as a share of the cube of their trace, below which its pixels hold no
plane. A full window has about 1e-9."""

JUMP, JUMP_M = 0.05, 0.05
"""A surface that is nearer by more than this share of depth and these metres has an edge."""

MOST_REACH = 32
"""Pixels to each side within which such edges are looked for, at most."""

NOWHERE_M = np.float32(1e9)
"""Stands for the depth of a pixel without a measurement."""

ASYMMETRY = 1e-6
"""Share of its largest entry by which a covariance may differ from its transpose, or have a negative
eigenvalue: rounding."""


def checked_covariance(pose_covariance: ArrayLike | None) -> Covariance | None:
    """A copy of a (6, 6) covariance of a pose, exactly symmetric; None for None and for one that is all zero.
    Raises KeyframeError if it is none."""
    if pose_covariance is None:
        return None
    try:
        C = np.array(pose_covariance, np.float64)
    except (TypeError, ValueError) as error:
        raise KeyframeError("pose_covariance is not a matrix of numbers") from error
    if C.shape != (6, 6):
        raise KeyframeError(f"pose_covariance has the shape {C.shape}, not (6, 6)")
    if not np.isfinite(C).all():
        raise KeyframeError("pose_covariance holds a value that is not finite (NaN or infinity)")
    rounding = ASYMMETRY * float(np.abs(C).max())
    asymmetry = float(np.abs(C - C.T).max())
    if asymmetry > rounding:
        raise KeyframeError(
            f"pose_covariance is not symmetric: it differs from its transpose by {asymmetry:.3g}"
        )
    C = 0.5 * (C + C.T)
    lowest = float(np.linalg.eigvalsh(C).min())
    if lowest < -rounding:
        raise KeyframeError(f"pose_covariance is not positive semi-definite: an eigenvalue is {lowest:.3g}")
    return C if C.any() else None


def covariance_of(translation_m: float, rotation_rad: float) -> Covariance:
    """The covariance (6, 6) of a pose whose errors are independent, with these standard deviations along and
    about each axis."""
    return np.diag(np.repeat(np.square([translation_m, rotation_rad]), 3))


def depth_sigma(depth_m: NDArray[np.floating], camera: Camera, covariance: Covariance) -> Image:
    """Standard deviation, (H, W) metres, of the depth at which the rays of an image (H, W) meet the surface
    that it has measured, for a ``covariance`` (6, 6) of its pose; 0 where there is no measurement."""
    measured = depth_m > 0
    p, d = _points_and_rays(depth_m, camera)
    n = _planes(p, np.where(measured, depth_m, np.inf), d, camera)
    along = np.maximum(_dot(n, d), STEEPEST * np.sqrt(_dot(n, n) * _dot(d, d)))
    return np.where(
        measured, np.sqrt(_variance_along(n, p, covariance)) / np.where(measured, along, 1.0), 0.0
    )


def beside_edges(depth_m: NDArray[np.floating], camera: Camera, covariance: Covariance) -> NDArray[np.bool_]:
    """Pixels (H, W) that have measured what is behind the edge of a nearer surface, which covers them if the
    pose is off by one standard deviation across the rays. None if pixels have no neighbours."""
    measured = depth_m > 0
    if camera.pixels_per_radian == 0 or not measured.any():
        return np.zeros(camera.shape, bool)
    p, d = _points_and_rays(depth_m, camera)
    # The rest of the variance is across the ray, in two directions.
    along = _variance_along(d / np.sqrt(_dot(d, d)), p, covariance)
    across = 0.5 * np.maximum(_total_variance(p, covariance) - along, 0.0)
    distances = np.where(measured, np.sqrt(_dot(p, p)), np.inf)
    reach = np.minimum(np.rint(np.sqrt(across) / distances * camera.pixels_per_radian), MOST_REACH)
    depth = np.where(measured, depth_m, NOWHERE_M).astype(np.float32)
    nearest = depth.copy()
    for radius in range(1, int(reach.max()) + 1):
        side = 2 * radius + 1
        moving = np.where(reach >= radius, depth, NOWHERE_M)
        nearest = np.minimum(nearest, cv2.erode(moving, np.ones((side, side), np.uint8)))
    return measured & (depth - nearest > JUMP_M + JUMP * depth)


def _points_and_rays(depth_m: NDArray[np.floating], camera: Camera) -> tuple[Image, Image]:
    """Measured points of pixels and the rays through them, (3, H, W) in the camera's frame."""
    points, rays = points_at(camera, depth_m), camera.rays()
    return np.moveaxis(points, -1, 0).copy(), np.moveaxis(rays, -1, 0).copy()


def _variance_along(e: Image, p: Image, covariance: Covariance) -> Image:
    """The variance (H, W) of e . (rho + omega x p): how far points p move along vectors e, (3, H, W) each."""
    row = np.concatenate([e, np.cross(p, e, axis=0)]).reshape(6, -1)
    return np.asarray(np.maximum(((covariance @ row) * row).sum(axis=0), 0.0).reshape(p.shape[1:]))


def _total_variance(p: Image, covariance: Covariance) -> Image:
    """Sum of the variances (H, W) along all three axes: the trace of J C J' with J = (1, -[p]x)."""
    A, B, D = covariance[:3, :3], covariance[:3, 3:], covariance[3:, 3:]
    twice = 2.0 * np.array([B[1, 2] - B[2, 1], B[2, 0] - B[0, 2], B[0, 1] - B[1, 0]])
    points = p.reshape(3, -1)
    turned = ((np.trace(D) * np.eye(3) - D) @ points + twice[:, None]) * points
    return np.asarray((np.trace(A) + turned.sum(axis=0)).reshape(p.shape[1:]))


def _planes(points: Image, depth_m: Image, rays: Image, camera: Camera) -> Image:
    """The n (3, H, W) of the plane n . q = 1 of the least squares through the points (3, H, W) around each
    pixel; of a plane across the ray where there are too few. Points count by their inverse depth, which is 0
    where nothing was measured."""
    across = rays / (_dot(rays, rays) * np.where(np.isinf(depth_m), 1.0, depth_m))
    if camera.pixels_per_radian == 0:
        return across
    half = max(1, round(WINDOW * camera.pixels_per_radian))
    step = -(-half // MOST_STEPS)
    side = 2 * (half // step) + 1

    def around(values: Image) -> Image:
        kind = cv2.BORDER_CONSTANT
        return np.asarray(cv2.boxFilter(values, -1, (side, side), normalize=False, borderType=kind))

    some_m = depth_m[::step, ::step]
    x, y, z = points[:, ::step, ::step] / some_m
    xy, xz, yz = around(x * y), around(x * z), around(y * z)
    first = np.stack([around(x * x), xy, xz])
    second = np.stack([xy, around(y * y), yz])
    third = np.stack([xz, yz, around(z * z)])
    s = [around(each / some_m) for each in (x, y, z)]
    # Cramer's rule: the matrix of moments is symmetric.
    a, b, c = np.cross(second, third, axis=0), np.cross(third, first, axis=0), np.cross(first, second, axis=0)
    determinant = _dot(first, a)
    found = determinant > FLATTEST * np.maximum(first[0] + second[1] + third[2], 1.0) ** 3
    n = (s[0] * a + s[1] * b + s[2] * c) / np.where(found, determinant, 1.0)
    n[:, ~found] = np.nan
    height, width = camera.shape
    n = n.repeat(step, axis=1).repeat(step, axis=2)[:, :height, :width]
    return np.where(np.isnan(n), across, n)


def _dot(a: Image, b: Image) -> Image:
    """a . b of vectors (3, ...)."""
    return np.asarray(np.einsum("i...,i...->...", a, b))


@dataclass(frozen=True)
class DoubtfulNoiseTable(ScaledNoiseTable):
    """A sensor's noise, scaled so that at the measured depths it has the pose's share, at most ``most_m``."""

    of_sensor: CameraNoise
    most_m: float

    def largest(self, depth_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bounds for measurements at some depths, (N,): scales of near pixels say nothing of far ones."""
        sigma, bias = self.of_sensor.largest(depth_m)
        return np.hypot(sigma, self.most_m), bias


def doubtful_table(
    table: CameraNoise, depth_m: NDArray[np.floating], camera: Camera, covariance: Covariance
) -> DoubtfulNoiseTable:
    """The noise of an image's pixels for a covariance (6, 6) of its pose; ``table`` is the sensor's alone.
    Raises ConfigError if its sigma cannot be scaled."""
    of_pose = depth_sigma(depth_m, camera, covariance)
    of, scale = table, np.hypot(1.0, of_pose / sigma_to_scale(table, depth_m))
    if isinstance(table, ScaledNoiseTable) and table.added_m == 0:
        of, scale = table.of, scale * table.scale
    return DoubtfulNoiseTable(of, scale.astype(np.float32), 0.0, table, float(of_pose.max(initial=0.0)))


@dataclass(frozen=True)
class DoubtfulPose:
    """The noise of one depth image (H, W) whose pose has a covariance (6, 6)."""

    noise: NoiseModel
    covariance: Covariance
    depth_m: NDArray[np.floating]

    def table(self, camera: Camera) -> DoubtfulNoiseTable:
        """The noise of the image's pixels. Raises ConfigError if the model does not fit the camera, or if its
        sigma cannot be scaled."""
        return doubtful_table(self.noise.table(camera), self.depth_m, camera, self.covariance)
