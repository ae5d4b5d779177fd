"""Cameras, which turn pixels into rays: the pinhole, and the interface of any other kind.

Kernels get their part of a camera from ``in_kernels``; importing this file does not load Taichi.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import instance, real, whole
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.stored import Arrays, Stored

if TYPE_CHECKING:
    from taichi_mrf.sensor.rays import CameraRays


_NO_SKEW = 1e-6
"""Entries of a camera matrix below this share of fx come from rounding."""


@runtime_checkable
class Camera(Protocol):
    """Interface of a camera, as mapping needs it.

    A camera is immutable; cameras with the same rays are equal, and have the same ``repr``.
    Depth is the parameter of a ray along its direction: axial depth if directions have z = 1, range if they
    have the length 1.

    Rays start at the camera's centre. Those of a camera that moves while it measures start at ``origins_m``
    and ``origins(u, v)``, which it has as RayTable has them, and its ``in_kernels`` is ``moving`` (rays.py).
    Such a camera's ``project`` counts depth from there.
    """

    @property
    def width(self) -> int:
        """Columns of the image."""

    @property
    def height(self) -> int:
        """Rows of the image."""

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""

    @property
    def up(self) -> tuple[float, float, float]:
        """Upwards in the camera frame, if it is held level."""

    @property
    def pixels_per_radian(self) -> float:
        """Pixels along one radian, where there are fewest; 0 if neighbouring pixels may look anywhere."""

    def directions(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """Rays through columns and rows that broadcast with each other, (..., 3) in the camera frame for one
        metre of depth. Whole numbers are pixels' centres."""

    def rays(self) -> NDArray[np.float64]:
        """:meth:`directions` of all pixels, (H, W, 3)."""

    def project(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column, row and depth at which points (N, 3) of the camera frame are seen, (N, 3), NaN for those
        that no pixel sees."""

    def thinned(self, step: int) -> "Camera":
        """The camera of every ``step``-th column and row."""

    def tile_hulls(self, tile: int) -> NDArray[np.float64]:
        """For each square of ``tile`` pixels, (rows, columns, k, 3): directions for one metre of depth whose
        convex hull, with the camera's centre, holds all points of its rays up to that depth, if they start
        there."""

    def most_pixels_in_cone(self, half_angle: float, block: int) -> float:
        """A bound on the pixels in a cone of ``half_angle`` radians, wherever it points, and in the square
        blocks of ``block`` pixels a side whose middle lies in it."""

    def in_kernels(self) -> "CameraRays":
        """The camera as kernels take it."""


@dataclass(frozen=True)
class PinholeCamera(Stored):
    """An undistorted pinhole camera; all lengths in pixels.

    The ray of pixel (u, v) (column, row) goes through the pixel's centre, which has the coordinates (u, v): a
    centred principal point is ((W - 1) / 2, (H - 1) / 2).
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

    @classmethod
    def of_row(cls, row: NDArray[np.number]) -> "PinholeCamera":
        """The camera of :attr:`row`."""
        width, height, *rest = row.tolist()
        return cls(int(width), int(height), *rest)

    @property
    def row(self) -> NDArray[np.float64]:
        """Width, height, fx, fy, cx, cy, as files hold them."""
        return np.array([self.width, self.height, self.fx, self.fy, self.cx, self.cy], np.float64)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"pinhole": self.row}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "PinholeCamera":
        return cls.of_row(file.array("pinhole", "f", (6,)))

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of this camera's images."""
        return self.height, self.width

    def scaled(self, factor: float) -> "PinholeCamera":
        """Camera of the same view with ``factor`` times as many pixels along each side."""
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

    @property
    def up(self) -> tuple[float, float, float]:
        """Upwards in the camera frame: -y."""
        return 0.0, -1.0, 0.0

    @property
    def pixels_per_radian(self) -> float:
        """The smaller focal length: pixels along one radian at the image's centre."""
        return min(self.fx, self.fy)

    def directions(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """Rays through columns and rows that broadcast with each other, (..., 3) in the camera frame, z = 1.

        A ray's parameter along these is axial depth; times ``range_per_depth`` it is Euclidean range.
        """
        x, y = np.broadcast_arrays((np.asarray(u) - self.cx) / self.fx, (np.asarray(v) - self.cy) / self.fy)
        return np.stack([x, y, np.ones(x.shape)], axis=-1)

    def rays(self) -> NDArray[np.float64]:
        """Directions of all pixels in the camera frame, (H, W, 3), with z = 1."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return self.directions(u, v)

    def project(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column, row and axial depth at which points (N, 3) of the camera frame are seen, (N, 3), NaN for
        those that no pixel sees."""
        x, y, z = points_m.T
        ahead = np.where(z > 0, z, np.nan)
        u, v = self.fx * x / ahead + self.cx, self.fy * y / ahead + self.cy
        inside = (u >= -0.5) & (u < self.width - 0.5) & (v >= -0.5) & (v < self.height - 0.5)
        return np.where(inside[:, None], np.stack([u, v, ahead], axis=1), np.nan)

    def thinned(self, step: int) -> "PinholeCamera":
        """The camera of every ``step``-th column and row."""
        width, height = -(-self.width // step), -(-self.height // step)
        return PinholeCamera(width, height, self.fx / step, self.fy / step, self.cx / step, self.cy / step)

    def tile_hulls(self, tile: int) -> NDArray[np.float64]:
        """The outer corners of each square of ``tile`` pixels as directions, (rows, columns, 4, 3), z = 1."""
        u = np.minimum(np.arange(-(-self.width // tile) + 1) * tile, self.width) - 0.5
        v = np.minimum(np.arange(-(-self.height // tile) + 1) * tile, self.height) - 0.5
        corners = self.directions(u[None, :], v[:, None])
        sides = slice(None, -1), slice(1, None)
        return np.stack([corners[row, column] for column in sides for row in sides], axis=2)

    def most_pixels_in_cone(self, half_angle: float, block: int) -> float:
        """A bound on the pixels in a cone of ``half_angle`` radians, wherever it points, and in the square
        blocks of ``block`` pixels a side whose middle lies in it.

        It is the cone's solid angle at the image's corner, where pixels are densest, and the blocks along its
        rim.
        """
        slant = self.largest_slant()
        density = self.fx * self.fy * slant**3  # pixels for each unit of solid angle
        solid_angle = 2 * math.pi * (1 - math.cos(half_angle))
        rim = 2 * math.pi * half_angle * slant**2 * max(self.fx, self.fy)  # pixels along the cone's edge
        return density * solid_angle + rim * block + 4 * block**2

    def in_kernels(self) -> "CameraRays":
        """The camera as kernels take it: a rays.PinholeRays."""
        from taichi_mrf.sensor.rays import PinholeRays
        from taichi_mrf.system.compiler import ti

        return PinholeRays(self.width, ti.Vector([self.fx, self.fy, self.cx, self.cy], ti.f32))

    def range_per_depth(self) -> NDArray[np.float64]:
        """Euclidean range of each pixel's ray for one metre of axial depth, (H, W), at least 1."""
        return np.linalg.norm(self.rays(), axis=-1)

    def largest_slant(self) -> float:
        """The largest entry of :meth:`range_per_depth`, which belongs to a corner of the image."""
        x = max(abs(self.cx), abs(self.width - 1 - self.cx)) / self.fx
        y = max(abs(self.cy), abs(self.height - 1 - self.cy)) / self.fy
        return math.hypot(1.0, x, y)


def pinhole(camera: Camera, who: str) -> PinholeCamera:
    """The camera, where only a pinhole works. Raises ConfigError for any other; its text begins with ``who``,
    such as "--undistort"."""
    if not isinstance(camera, PinholeCamera):
        raise ConfigError(f"{who} needs a pinhole camera, not a {type(camera).__name__}")
    return camera


def forwards(camera: Camera) -> NDArray[np.float64]:
    """The direction in the camera frame in which a level camera looks, (3,): z if y is down, x if z is up."""
    return np.array([1.0, 0.0, 0.0] if camera.up[2] else [0.0, 0.0, 1.0])


def sees_around(camera: Camera) -> bool:
    """True if a camera sees more than about 220 of the 360 degrees around it."""
    u, v = (np.unique(np.linspace(0, n - 1, 256).round()) for n in (camera.width, camera.height))
    rays, up = (
        camera.directions(u[None, :], v[:: max(1, len(v) // 16), None]).reshape(-1, 3),
        np.array(camera.up),
    )
    level = rays - np.outer(rays @ up, up)
    level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    # The mean of directions that fill a sector of the angle w has the length sin(w / 2) / (w / 2).
    return bool(np.linalg.norm(level.mean(axis=0)) < 0.5)


def check_camera(camera: object) -> None:
    """Raise ArgumentTypeError for an argument ``camera`` that is none."""
    instance(camera, Camera, "camera", "a camera such as PinholeCamera")
