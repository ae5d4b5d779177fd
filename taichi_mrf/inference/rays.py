"""Which pixels become rays, and who follows them.

Near the camera a voxel covers hundreds of pixels, whose rays all tell it the same. They are thinned on a
regular pixel grid until a voxel that faces the camera is still met by the wanted number.
"""

import math

import taichi as ti

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.config import InferenceConfig
from taichi_mrf.voxels.types import F32, I32, Vec3, Vec4


def stride_metres(camera: PinholeCamera, voxel_size: float, config: InferenceConfig) -> float:
    """Stride between rays, in pixels, times the depth in metres: a voxel at depth z covers
    voxel_size * f / z pixels along each side. 0 casts every pixel."""
    if config.rays_per_voxel == 0:
        return 0.0
    return voxel_size * min(camera.fx, camera.fy) / math.sqrt(config.rays_per_voxel)


@ti.func
def pixel_direction(u: I32, v: I32, intrinsics: Vec4):
    """The ray through the centre of pixel (u, v) in the camera frame, for one metre of axial depth;
    ``intrinsics`` are fx, fy, cx, cy in pixels."""
    return Vec3((u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1], 1.0)


@ti.func
def is_cast(u: I32, v: I32, measured: F32, stride_metres: F32) -> I32:
    """Whether pixel (u, v) holds a measurement, in metres, and lies on the grid for its depth."""
    cast = 0
    if measured > 0.0:
        stride = ti.max(1, ti.cast(stride_metres / measured, ti.i32))
        cast = u % stride == 0 and v % stride == 0
    return cast


@ti.func
def deals(workers: I32, tile: I32, width: I32, height: I32) -> I32:
    """How many pixels each worker is dealt, those outside the image included."""
    tiles = ((width + tile - 1) // tile) * ((height + tile - 1) // tile)
    return (tiles + workers - 1) // workers * tile * tile


@ti.func
def dealt_pixel(worker: I32, turn: I32, workers: I32, tile: I32, width: I32):
    """The pixel (u, v) of a worker's turn: whole square tiles go to one worker, because the rays of a tile
    cross the same bricks. It may lie outside the image."""
    across = (width + tile - 1) // tile
    number = turn // (tile * tile) * workers + worker
    return number % across * tile + turn % tile, number // across * tile + turn // tile % tile
