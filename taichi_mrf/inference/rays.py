"""Which pixels become rays: no more than the voxels need.

Near the camera a voxel covers hundreds of pixels, whose rays all tell it the same. They are thinned on a
regular pixel grid until a voxel that faces the camera is still met by the wanted number.
"""

import math

import taichi as ti

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.config import InferenceConfig
from taichi_mrf.voxels.types import F32, I32


def stride_metres(camera: PinholeCamera, voxel_size: float, config: InferenceConfig) -> float:
    """Stride between rays, in pixels, times the depth in metres: a voxel at depth z covers
    voxel_size * f / z pixels along each side. 0 casts every pixel."""
    if config.rays_per_voxel == 0:
        return 0.0
    return voxel_size * min(camera.fx, camera.fy) / math.sqrt(config.rays_per_voxel)


@ti.func
def is_cast(u: I32, v: I32, measured: F32, stride_metres: F32) -> I32:
    """Whether pixel (u, v) holds a measurement, in metres, and lies on the grid for its depth."""
    cast = 0
    if measured > 0.0:
        stride = ti.max(1, ti.cast(stride_metres / measured, ti.i32))
        cast = u % stride == 0 and v % stride == 0
    return cast
