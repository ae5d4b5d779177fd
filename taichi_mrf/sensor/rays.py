"""Rays of pixels: which way they go, and who follows them."""

import taichi as ti

from taichi_mrf.kernels.types import F32, I32, Vec3, Vec4


@ti.func
def pixel_direction(u: F32, v: F32, intrinsics: Vec4):
    """The ray through pixel (u, v), whole numbers for its centre, in the camera frame, for one metre of axial
    depth; ``intrinsics`` are fx, fy, cx, cy in pixels."""
    return Vec3((u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1], 1.0)


@ti.func
def deals(workers: I32, run: I32, rays: I32) -> I32:
    """How many rays each worker is dealt, those beyond the last included."""
    runs = (rays + run - 1) // run
    return (runs + workers - 1) // workers * run


@ti.func
def dealt_ray(worker: I32, turn: I32, workers: I32, run: I32) -> I32:
    """The ray of a worker's turn: runs of neighbouring rays go to one worker, because they cross the same
    bricks. It may lie beyond the last."""
    return (turn // run * workers + worker) * run + turn % run
