"""Averages of many rays' messages, added up in any order with the same result.

A voxel's average needs two sums over rays, of lengths and of lengths times messages. Both are kept as
fixed-point numbers in the halves of one 64-bit integer, so that a ray's contribution is a single
atomic addition. Integers make the sum exact: it does not depend on the order of the rays, and hence a
map is the same, bit for bit, on one thread or many.
"""

import math

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.origins import ball_of
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, Template
from taichi_mrf.voxels.layout import BRICK
from taichi_mrf.voxels.window import Window

LONGEST = math.sqrt(3.0)
"""Longest way through a voxel, in voxel sizes."""

HALF_VOXEL = LONGEST / 2


@ti.func
def add_message(sums: Template, index: I32, length: F32, message: F32, scale: F32):
    """Add one ray's message in [0, 1], weighted by the length of its way through the voxel."""
    lengths = ti.cast(length * scale + 0.5, ti.i64)
    messages = ti.cast(length * message * scale + 0.5, ti.i64)
    ti.atomic_add(sums[index], (messages << 32) + lengths)


@ti.func
def low_half(packed: ti.i64):
    """The lower 32 bits: the sum of lengths."""
    return packed - ((packed >> 32) << 32)


@ti.func
def length_sum(packed: ti.i64, scale: F32) -> F32:
    """The summed length, in voxel sizes."""
    return ti.cast(low_half(packed), ti.f32) / scale


@ti.func
def mean_message(packed: ti.i64) -> F32:
    """The length-weighted mean message, in [0, 1]; a mean of ones is 1 where division is not exact, too."""
    lengths, messages = ti.max(ti.cast(low_half(packed), ti.f32), 1.0), ti.cast(packed >> 32, ti.f32)
    return ti.select(messages >= lengths, 1.0, messages / lengths)


def finest_scale(
    camera: Camera,
    rays: int,
    T_world_camera: Pose,
    window: Window,
    bricks: NDArray[np.int32],
    widest: int = 1,
) -> float:
    """The largest power of two by which lengths can be scaled before a sum could overflow 31 bits.

    A voxel at a distance of D voxels lies in the cone of the sphere around it, and the camera bounds the
    pixels in a cone. If rays start at several places, a ray that meets the sphere is turned from the way
    between the middles of sphere and places by no more than if both radii were the sphere's.
    ``bricks`` (n, 3) are those that the rays may meet; ``rays`` are counted as the pixels that they stand
    for, squares of ``widest`` pixels a side at most.
    """
    middle_m, spread_m = ball_of(camera)
    centre_m = T_world_camera[:3, :3] @ middle_m + T_world_camera[:3, 3]
    centre = window.to_voxels(centre_m) + np.asarray(window.lowest) * BRICK
    low = bricks.astype(np.float64) * BRICK
    beside = np.maximum(np.maximum(low - centre, centre - (low + BRICK)), 0.0)
    nearest = float(np.sqrt((beside**2).sum(axis=1)).min()) if len(bricks) else 0.0
    most = float(rays)
    sphere = HALF_VOXEL + spread_m / window.voxel_size
    if nearest > max(2.0, sphere):
        radius = math.asin(sphere / (nearest + HALF_VOXEL))  # the distance is that of the voxel's centre
        most = min(most, camera.most_pixels_in_cone(radius, widest))
    return 2.0 ** math.floor(math.log2(2**31 / (LONGEST * max(most, 1.0) + 1)))
