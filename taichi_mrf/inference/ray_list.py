"""The rays that a keyframe casts: its pixels, or bundles of pixels where a voxel covers many.

Near the camera a voxel covers hundreds of pixels, whose rays send it nearly the same message. Blocks of
pixels are therefore merged, two of a size at a time, as long as enough rays still meet a voxel at their depth
and their measurements agree, and their sigmas where each pixel has its own. The ray through a block's middle
has their mean depth, and their number as its weight. Pixels that do not agree, such as those at the edge of a
surface, keep rays of their own.
"""

import math
from dataclasses import dataclass

import numpy as np

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.keyframe import TILE, DepthImage, RayList
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, Template
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.traversal import pixel_ray

LEVELS = 10
"""A block of level n has 2^n pixels: the odd levels put two blocks side by side, the even ones two above each
other, so that a block is square or twice as wide as high."""

BITS = 4
"""Of a ray's number, for its level; the rest is the number of its block's first pixel."""

AGREE_VOXELS = 0.5
AGREE_SIGMAS = 2.0
"""Measurements agree if they differ by no more than either of these."""

SPREAD = 512
"""Taichi gives a CPU thread no fewer iterations than this; each tile is made to count for so many."""


@ti.func
def block_of(ray: I32, width: I32):
    """The first pixel (u, v) of the block that a ray of the list stands for, its columns and its rows."""
    pixel, level = ray >> BITS, ray & ((1 << BITS) - 1)
    return pixel % width, pixel // width, 1 << (level + 1) // 2, 1 << level // 2


@ti.func
def listed_ray(rays: Template, i: I32, sensor: Template, view: Template):
    """Ray i of a list (keyframe.RayList): the ray through the middle of its block, the noise there, and how
    many pixels the block has."""
    u, v, wide, high = block_of(rays.blocks[i], sensor.camera.width)
    ray = pixel_ray(sensor, view, u + 0.5 * (wide - 1), v + 0.5 * (high - 1))
    return ray, sensor.noise_at(u + wide // 2, v + high // 2), wide * high


def stride_metres(camera: Camera, voxel_size: float, ray_density: float) -> float:
    """Distance between rays, in pixels, times the depth in metres: a voxel at depth z covers
    voxel_size * pixels_per_radian / z pixels along each side. 0 casts every pixel."""
    if ray_density == 0:
        return 0.0
    rays_per_voxel = max(1.0, ray_density * 100.0 * voxel_size)
    return voxel_size * camera.pixels_per_radian / math.sqrt(rays_per_voxel)


class RayBundler:
    """Makes the lists of rays for one voxel size; owns the scratch, which grows to the largest image."""

    def __init__(self, voxel_size: float, inference: InferenceConfig) -> None:
        self.voxel_size, self.inference = voxel_size, inference
        self._nearest = ti.ndarray(ti.f32, 1)
        self._farthest = ti.ndarray(ti.f32, 1)
        self._mean = ti.ndarray(ti.f32, 1)
        self._level = ti.ndarray(ti.i32, 1)

    def rays_of(self, image: DepthImage) -> RayList:
        """The rays that an image casts, wherever it was taken."""
        camera = image.camera
        self._reserve(camera.width * camera.height)
        tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        stride = stride_metres(camera, self.voxel_size, self.inference.ray_density)
        counts, widest = np.zeros(tiles, np.int32), np.ones(tiles, np.int32)
        rule = _MergeRule(stride, AGREE_VOXELS * self.voxel_size, AGREE_SIGMAS)
        blocks_of_pixels = _PixelBlocks(self._nearest, self._farthest, self._mean, self._level)
        _choose(image.depth, image.sensor, rule, blocks_of_pixels, counts)
        number = int(counts.sum())
        blocks, depth = ti.ndarray(ti.i32, max(1, number)), ti.ndarray(ti.f32, max(1, number))
        first = np.cumsum(counts, dtype=np.int32) - counts
        _write_down(camera.width, camera.height, self._mean, self._level, first, blocks, depth, widest)
        return RayList(blocks, depth, number, int(widest.max()))

    def _reserve(self, pixels: int) -> None:
        if pixels > self._level.shape[0]:
            self._nearest, self._farthest, self._mean = (ti.ndarray(ti.f32, pixels) for _ in range(3))
            self._level = ti.ndarray(ti.i32, pixels)


@dataclass(frozen=True)
class _MergeRule(Bundle):
    """The conditions under which a block of pixels becomes one ray."""

    stride_metres: F32
    """See :func:`stride_metres`."""

    agree_m: F32
    """Measurements in metres agree if they differ by no more than this,"""

    agree_sigmas: F32
    """or by no more than this many sigma."""


@dataclass(frozen=True)
class _PixelBlocks(Bundle):
    """The blocks that begin at each pixel, row by row. All arrays (H * W)."""

    nearest: F32Array
    """The smallest measurement in the block, metres."""

    farthest: F32Array
    """The largest one."""

    mean: F32Array
    """Their mean."""

    level: I32Array
    """The block's level, -1 where none begins."""


@ti.func
def _merge(rule: Template, blocks: Template, sensor: Template, u: I32, v: I32, n: I32):
    """Make one block of level ``n`` at pixel (u, v) of the two below it, if they are there and agree."""
    wide, high = 1 << (n + 1) // 2, 1 << n // 2
    a = v * sensor.camera.width + u
    b = a + (wide // 2 if n % 2 == 1 else high // 2 * sensor.camera.width)
    if blocks.level[a] == n - 1 and blocks.level[b] == n - 1:
        near = ti.min(blocks.nearest[a], blocks.nearest[b])
        far = ti.max(blocks.farthest[a], blocks.farthest[b])
        if wide * high * near * near <= rule.stride_metres * rule.stride_metres:
            agree = far - near <= rule.agree_m
            if not agree:  # the noise need not be looked up for most
                sigma = sensor.noise_at(u + wide // 2, v + high // 2).sigma(near)
                agree = far - near <= rule.agree_sigmas * sigma
            if ti.static(sensor.noise.own_sigmas):
                # Both halves are of one level each.
                column, row = b % sensor.camera.width, b // sensor.camera.width
                agree = agree and sensor.noise.sigma_level(u, v) == sensor.noise.sigma_level(column, row)
            if agree:
                blocks.nearest[a] = near
                blocks.farthest[a] = far
                blocks.mean[a] = 0.5 * (blocks.mean[a] + blocks.mean[b])
                blocks.level[a] = n
                blocks.level[b] = -1


@kernel
def _choose(
    depth: F32Array, sensor: Sensor, rule: _MergeRule, blocks: _PixelBlocks, counts: I32Array
) -> None:
    """Give each pixel the level of the block that begins there, or -1 if none does; count them by tile.

    ``depth`` is (H * W) metres, 0 without a measurement; ``counts`` (tiles) receives the number of rays.
    """
    width = sensor.camera.width
    height = depth.shape[0] // width
    across = (width + TILE - 1) // TILE
    for iteration in range(counts.shape[0] * SPREAD):
        if iteration % SPREAD == 0:
            tile = iteration // SPREAD
            left, top = tile % across * TILE, tile // across * TILE
            right, bottom = ti.min(left + TILE, width), ti.min(top + TILE, height)
            for v in range(top, bottom):
                for u in range(left, right):
                    i = v * width + u
                    measured = depth[i]
                    blocks.nearest[i] = measured
                    blocks.farthest[i] = measured
                    blocks.mean[i] = measured
                    blocks.level[i] = 0 if measured > 0.0 else -1
            for n in range(1, LEVELS + 1):
                wide, high = 1 << (n + 1) // 2, 1 << n // 2
                for block in range(TILE * TILE >> n):
                    u = left + block % (TILE // wide) * wide
                    v = top + block // (TILE // wide) * high
                    if u + wide <= right and v + high <= bottom:
                        _merge(rule, blocks, sensor, u, v, n)
            rays = 0
            for v in range(top, bottom):
                for u in range(left, right):
                    rays += ti.cast(blocks.level[v * width + u] >= 0, ti.i32)
            counts[tile] = rays


@ti.kernel
def _write_down(
    width: I32, height: I32, mean: F32Array, level: I32Array, first: I32Array,
    blocks: I32Array, depth: F32Array, widest: I32Array,
):  # fmt: skip
    """List the blocks that begin in each tile, from its place ``first`` (tiles) in the list on.

    ``mean`` (H * W) metres and ``level`` (H * W) are those of _PixelBlocks, ``blocks`` and ``depth`` (rays)
    those of the list. ``widest`` (tiles) receives the largest side of a block in pixels.
    """
    across = (width + TILE - 1) // TILE
    for iteration in range(first.shape[0] * SPREAD):
        if iteration % SPREAD == 0:
            tile = iteration // SPREAD
            left, top = tile % across * TILE, tile // across * TILE
            ray = first[tile]
            highest = 0
            for v in range(top, ti.min(top + TILE, height)):
                for u in range(left, ti.min(left + TILE, width)):
                    i = v * width + u
                    if level[i] >= 0:
                        blocks[ray] = (i << BITS) + level[i]
                        depth[ray] = mean[i]
                        highest = ti.max(highest, level[i])
                        ray += 1
            widest[tile] = 1 << (highest + 1) // 2
