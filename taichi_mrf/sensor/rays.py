"""Cameras in kernels: the ray of each pixel. How cameras plug in: sensor/model.py."""

from dataclasses import dataclass
from typing import Any, ClassVar

import taichi as ti

from taichi_mrf.kernels.bundles import Bundle
from taichi_mrf.kernels.types import F32, I32, Vec3, Vec4


@dataclass(frozen=True)
class CameraRays(Bundle):
    """The base of all cameras in kernels."""

    width: I32
    """Columns of the image."""

    direction: ClassVar[Any]
    """A ti.func, as PinholeRays has it."""

    plane: ClassVar[Any]
    """A ti.func, as PinholeRays has it."""

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
