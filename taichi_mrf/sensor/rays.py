"""Cameras in kernels: the ray of each pixel. How cameras plug in: sensor/model.py."""

from dataclasses import dataclass
from typing import Any, ClassVar

from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array2, Vec3, Vec4


@dataclass(frozen=True)
class CameraRays(Bundle):
    """The base of all cameras in kernels."""

    width: I32
    """Columns of the image."""

    direction: ClassVar[Any]
    """A ti.func, as PinholeRays has it."""

    plane: ClassVar[Any]
    """A ti.func, as PinholeRays has it."""

    origin: ClassVar[Any]
    """A ti.func, as MovingTableRays has it, if the camera is ``moving``."""

    moving: ClassVar[bool] = False
    """True if rays start at places of their own, which ``origin`` gives. Otherwise all start at the camera's
    centre, and kernels are compiled without ``origin``."""

    @ti.func
    def pixel(self, number: I32):
        """Column and row of a pixel from its number, row by row."""
        return number % self.width, number // self.width


@dataclass(frozen=True)
class PinholeRays(CameraRays):
    """A pinhole camera. Depth along its rays is axial depth."""

    intrinsics: Vec4
    """fx, fy, cx, cy in pixels."""

    @ti.func
    def direction(self, u: F32, v: F32):
        """The ray through column u and row v, whole numbers for a pixel's centre, in the camera frame: the
        way for one metre of depth."""
        return Vec3(
            (u - self.intrinsics[2]) / self.intrinsics[0], (v - self.intrinsics[3]) / self.intrinsics[1], 1.0
        )

    @ti.func
    def plane(self, u: F32, v: F32, along_u: F32, along_v: F32, inverse: F32):
        """The plane n . x = 1 of the camera frame that is seen at (u, v) with an ``inverse`` depth, 1/m, that
        changes by ``along_u`` and ``along_v`` for each pixel; returns n.

        n . direction is the inverse depth, and a pinhole's direction is linear in u and v.
        """
        ray = self.direction(u, v)
        n = Vec3(along_u * self.intrinsics[0], along_v * self.intrinsics[1], 0.0)
        n[2] = inverse - n[0] * ray[0] - n[1] * ray[1]
        return n


@dataclass(frozen=True)
class TableRays(CameraRays):
    """The directions of all pixels in a table (ray_table.RayTable). Depth is the parameter along them."""

    height: I32
    """Rows of the image."""

    unit: I32
    """1 if all directions have the length 1, which those between pixels then have too."""

    table: F32Array2
    """(H * W, 3)"""

    @ti.func
    def direction(self, u: F32, v: F32):
        """The ray through column u and row v, whole numbers for a pixel's centre; between pixels linear in
        both."""
        left, top = ti.cast(ti.floor(u), ti.i32), ti.cast(ti.floor(v), ti.i32)
        a, b = u - left, v - top
        ray = self._entry(left, top)
        if a > 0.0 or b > 0.0:
            above = ray + a * (self._entry(left + 1, top) - ray)
            first, second = self._entry(left, top + 1), self._entry(left + 1, top + 1)
            below = first + a * (second - first)
            ray = above + b * (below - above)
            if self.unit == 1:
                ray = ray / ray.norm()
        return ray

    @ti.func
    def _entry(self, u: I32, v: I32):
        """The direction of the pixel (u, v), or of the nearest one at the image's edge."""
        column, row = ti.max(0, ti.min(u, self.width - 1)), ti.max(0, ti.min(v, self.height - 1))
        i = row * self.width + column
        return Vec3(self.table[i, 0], self.table[i, 1], self.table[i, 2])

    @ti.func
    def plane(self, u: F32, v: F32, along_u: F32, along_v: F32, inverse: F32):
        """As PinholeRays has it: n . direction is the inverse depth at (u, v), and to first order around it.
        Where directions do not change, the plane that the ray meets at a right angle."""
        ray = self.direction(u, v)
        left, right = ti.max(0.0, u - 0.5), ti.min(self.width - 1.0, u + 0.5)
        top, bottom = ti.max(0.0, v - 0.5), ti.min(self.height - 1.0, v + 0.5)
        across = (self.direction(right, v) - self.direction(left, v)) / ti.max(right - left, 0.5)
        down = (self.direction(u, bottom) - self.direction(u, top)) / ti.max(bottom - top, 0.5)
        if ti.static(self.moving):
            # A step of the origin moves the point of one metre of depth by that much times the inverse depth.
            shift_u = (self.origin(right, v) - self.origin(left, v)) / ti.max(right - left, 0.5)
            shift_v = (self.origin(u, bottom) - self.origin(u, top)) / ti.max(bottom - top, 0.5)
            across += inverse * shift_u
            down += inverse * shift_v
        normal = across.cross(down)
        volume = ray.dot(normal)
        n = ray * (inverse / ray.dot(ray))
        if ti.abs(volume) > 1e-4 * across.norm() * down.norm() * ray.norm():
            n = (inverse * normal + along_u * down.cross(ray) + along_v * ray.cross(across)) / volume
        return n


@dataclass(frozen=True)
class MovingTableRays(TableRays):
    """Rays that start at places of their own (ray_table.RayTable with origins). The plane that ``plane``
    returns is seen from the origin of its pixel."""

    moving: ClassVar[bool] = True

    origins: F32Array2
    """(W, 3) metres in the camera frame, or (H * W, 3)."""

    of_rows: I32
    """1 if each row has origins of its own, 0 if they are those of the columns."""

    @ti.func
    def origin(self, u: F32, v: F32):
        """Start of the ray through column u and row v, in metres in the camera frame; between pixels linear
        in both."""
        left, top = ti.cast(ti.floor(u), ti.i32), ti.cast(ti.floor(v), ti.i32)
        a, b = u - left, v - top
        start = self._start(left, top)
        if a > 0.0 or b > 0.0:
            above = start + a * (self._start(left + 1, top) - start)
            first, second = self._start(left, top + 1), self._start(left + 1, top + 1)
            below = first + a * (second - first)
            start = above + b * (below - above)
        return start

    @ti.func
    def _start(self, u: I32, v: I32):
        """The origin of the pixel (u, v), or of the nearest one at the image's edge."""
        column, row = ti.max(0, ti.min(u, self.width - 1)), ti.max(0, ti.min(v, self.height - 1))
        i = self.of_rows * row * self.width + column
        return Vec3(self.origins[i, 0], self.origins[i, 1], self.origins[i, 2])
