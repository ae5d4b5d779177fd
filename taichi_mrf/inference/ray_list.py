"""The rays that a keyframe casts: its pixels, or bundles of pixels where a voxel covers many.

Near the camera a voxel covers hundreds of pixels, whose rays send it nearly the same message. Blocks of
pixels are therefore merged, two of a size at a time, as long as enough rays still meet a voxel at their depth
and their measurements agree, and their sigmas where each pixel has its own. The ray through a block's middle
has their mean depth, and their number as its weight. Pixels that do not agree, such as those at the edge of a
surface, keep rays of their own.

In front of all surfaces rays side by side tell voxels the same, that they are free, and there one for each
voxel is enough. Rays therefore form groups, larger blocks of pixels, which have one shared path up to where
the first of their rays may meet its surface.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.keyframe import TILE, DepthImage, RayList
from taichi_mrf.inference.ray_model import END_SIGMAS
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, Template
from taichi_mrf.voxels.traversal import FAR, pixel_ray

LEVELS = 10
"""A block of level n has 2^n pixels: the odd levels put two blocks side by side, the even ones two above each
other, so that a block is square or twice as wide as high."""

BITS = 4
"""Of a ray's number, for its level; the rest is the number of its block's first pixel."""

TILE_BITS = TILE.bit_length() - 1

AGREE_VOXELS = 0.5
AGREE_SIGMAS = 2.0
"""Measurements agree if they differ by no more than either of these."""

FREE_RAYS = 1.0
"""Shared paths that meet a voxel facing the camera, at least."""

CLEAR_VOXELS = 2.0
"""Rays part this many voxels in front of the first of their surfaces: more than the longest way through one,
so that no voxel is told by the shared path that it is free, in which a surface may be."""

SPREAD = 512
"""Taichi gives a CPU thread no fewer iterations than this; each tile is made to count for so many."""


@ti.func
def block_of(ray: I32, width: I32):
    """The first pixel (u, v) of the block that a ray of the list stands for, its columns and its rows."""
    pixel, level = ray >> BITS, ray & ((1 << BITS) - 1)
    return pixel % width, pixel // width, 1 << (level + 1) // 2, 1 << level // 2


@ti.func
def block_ray(block: I32, sensor: Template, view: Template):
    """The ray through the middle of a block of pixels."""
    u, v, wide, high = block_of(block, sensor.camera.width)
    return pixel_ray(sensor, view, u + 0.5 * (wide - 1), v + 0.5 * (high - 1))


@ti.func
def block_noise(block: I32, sensor: Template):
    """The noise in the middle of a block of pixels."""
    u, v, wide, high = block_of(block, sensor.camera.width)
    return sensor.noise_at(u + wide // 2, v + high // 2)


@ti.func
def listed_ray(rays: Template, i: I32, sensor: Template, view: Template):
    """Ray i of a list (keyframe.RayList): the ray through the middle of its block, the noise there, and how
    many pixels the block has."""
    block = rays.blocks[i]
    _, _, wide, high = block_of(block, sensor.camera.width)
    return block_ray(block, sensor, view), block_noise(block, sensor), wide * high


@ti.func
def end_of_shared_path(rays: Template, group: I32, middle: Template, begin: F32, max_depth: F32) -> F32:
    """The depth up to which the rays of a group go along its ``middle`` ray from ``begin`` on. The voxel in
    which they part is one in which none of them can have met its surface."""
    apart = begin
    if rays.first[group + 1] - rays.first[group] > 1:  # a ray alone goes all its way by itself
        support = ti.min(rays.support[group], max_depth)
        apart = ti.max(begin, support - CLEAR_VOXELS / middle.direction.norm())
    return apart


def rays_per_voxel(voxel_size: float, ray_density: float) -> float:
    """Rays that meet a voxel facing the camera, at least; infinite where every pixel casts one."""
    return max(1.0, ray_density * 100.0 * voxel_size) if ray_density > 0 else math.inf


def stride_metres(camera: Camera, voxel_size: float, per_voxel: float) -> float:
    """Distance between so many rays for each voxel, in pixels, times the depth in metres: a voxel at depth z
    covers voxel_size * pixels_per_radian / z pixels along each side."""
    return voxel_size * camera.pixels_per_radian / math.sqrt(per_voxel)


class RayBundler:
    """Makes the lists of rays for one voxel size; owns the scratch, which grows to the largest image."""

    def __init__(self, voxel_size: float, inference: InferenceConfig, end_sigmas: float = END_SIGMAS) -> None:
        """Rays end ``end_sigmas`` beyond their measurement."""
        self.voxel_size, self.inference, self.end_sigmas = voxel_size, inference, end_sigmas
        self._nearest = ti.ndarray(ti.f32, 1)
        self._farthest = ti.ndarray(ti.f32, 1)
        self._mean = ti.ndarray(ti.f32, 1)
        self._level = ti.ndarray(ti.i32, 1)
        self._group = ti.ndarray(ti.i32, 1)

    def rays_of(self, image: DepthImage) -> RayList:
        """The rays that an image casts, wherever it was taken."""
        camera = image.camera
        self._reserve(camera.width * camera.height)
        tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        per_voxel = rays_per_voxel(self.voxel_size, self.inference.ray_density)
        free_per_voxel = math.inf if math.isinf(per_voxel) else min(per_voxel, FREE_RAYS)
        rule = _MergeRule(
            stride_metres(camera, self.voxel_size, per_voxel),
            stride_metres(camera, self.voxel_size, free_per_voxel),
            AGREE_VOXELS * self.voxel_size,
            AGREE_SIGMAS,
        )
        counts, groups, widest = (np.zeros(tiles, np.int32) for _ in range(3))
        pixels = _PixelBlocks(self._nearest, self._farthest, self._mean, self._level, self._group)
        choose = _choose_by_level if runtime.on_gpu() else _choose
        choose(image.depth, image.sensor, rule, pixels, counts, groups)
        rays = RayList.empty(int(counts.sum()), int(groups.sum()))
        first, first_group = (np.cumsum(each, dtype=np.int32) - each for each in (counts, groups))
        _write_down(camera.width, camera.height, pixels, first, first_group, rays, widest)
        _find_reach(rays, image.sensor, self.end_sigmas)
        return replace(rays, widest=int(widest.max()))

    def _reserve(self, pixels: int) -> None:
        if pixels > self._level.shape[0]:
            self._nearest, self._farthest, self._mean = (ti.ndarray(ti.f32, pixels) for _ in range(3))
            self._level, self._group = (ti.ndarray(ti.i32, pixels) for _ in range(2))


@dataclass(frozen=True)
class _MergeRule(Bundle):
    """The conditions under which a block of pixels becomes one ray, or a group of rays."""

    stride_metres: F32
    """See :func:`stride_metres`."""

    free_stride_metres: F32
    """Stride of groups, as above."""

    agree_m: F32
    """Measurements in metres agree if they differ by no more than this,"""

    agree_sigmas: F32
    """or by no more than this many sigma."""


@dataclass(frozen=True)
class _PixelBlocks(Bundle):
    """The blocks that begin at each pixel, row by row. All arrays (H * W)."""

    nearest: F32Array
    """The smallest measurement in the block, or in the group, metres; FAR without one."""

    farthest: F32Array
    """The largest one."""

    mean: F32Array
    """Their mean."""

    level: I32Array
    """The block's level, -1 where none begins."""

    group: I32Array
    """The level of the group that begins here, which holds whole blocks, -1 where none begins."""


@ti.func
def _merge(rule: Template, blocks: Template, sensor: Template, u: I32, v: I32, n: I32):
    """Make one block of level ``n`` at pixel (u, v) of the two below it, if they are there and agree, and one
    group of two groups. Groups need not agree: a ray that goes further than others does so by itself."""
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
    if blocks.group[a] == n - 1 and blocks.group[b] == n - 1:
        near = ti.min(blocks.nearest[a], blocks.nearest[b])
        if near >= FAR or wide * high * near * near <= rule.free_stride_metres * rule.free_stride_metres:
            blocks.nearest[a] = near
            blocks.group[a] = n
            blocks.group[b] = -1


@kernel
def _choose(
    depth: F32Array,
    sensor: Sensor,
    rule: _MergeRule,
    blocks: _PixelBlocks,
    counts: I32Array,
    groups: I32Array,
) -> None:
    """Give each pixel the levels of the block and the group that begin there, or -1 if none does; count them
    by tile.

    ``depth`` is (H * W) metres, 0 without a measurement; ``counts`` and ``groups`` (tiles) receive the
    numbers of rays and of groups with rays.
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
                    _begin(blocks, depth, v * width + u)
            for n in range(1, LEVELS + 1):
                wide, high = 1 << (n + 1) // 2, 1 << n // 2
                in_a_row = TILE_BITS - (n + 1) // 2  # their number's logarithm: no divisions
                for block in range(TILE * TILE >> n):
                    u = left + (block & ((1 << in_a_row) - 1)) * wide
                    v = top + (block >> in_a_row) * high
                    if u + wide <= right and v + high <= bottom:
                        _merge(rule, blocks, sensor, u, v, n)
            rays, grouped = 0, 0
            for v in range(top, bottom):
                for u in range(left, right):
                    i = v * width + u
                    rays += ti.cast(blocks.level[i] >= 0, ti.i32)
                    grouped += ti.cast(_has_rays(blocks, i), ti.i32)
            counts[tile] = rays
            groups[tile] = grouped


@kernel
def _choose_by_level(
    depth: F32Array,
    sensor: Sensor,
    rule: _MergeRule,
    blocks: _PixelBlocks,
    counts: I32Array,
    groups: I32Array,
) -> None:
    """As :func:`_choose` for a GPU, which makes all blocks of a level side by side. On a CPU a tile, which
    stays in the cache, is made level by level in a sixth less time."""
    for i in range(depth.shape[0]):
        _begin(blocks, depth, i)
    for n in ti.static(range(1, LEVELS + 1)):
        for block in range(counts.shape[0] * (TILE * TILE >> n)):
            tile, inner = block // (TILE * TILE >> n), block % (TILE * TILE >> n)
            wide, high, width = 1 << (n + 1) // 2, 1 << n // 2, sensor.camera.width
            across = (width + TILE - 1) // TILE
            u = tile % across * TILE + inner % (TILE // wide) * wide
            v = tile // across * TILE + inner // (TILE // wide) * high
            if u + wide <= width and v + high <= depth.shape[0] // width:
                _merge(rule, blocks, sensor, u, v, n)
    for i in range(depth.shape[0]):
        width = sensor.camera.width
        tile = i // width // TILE * ((width + TILE - 1) // TILE) + i % width // TILE
        if blocks.level[i] >= 0:
            counts[tile] += 1
        if _has_rays(blocks, i):
            groups[tile] += 1


@ti.func
def _begin(blocks: Template, depth: Template, i: I32):
    """Make a block and a group of one pixel."""
    measured = depth[i]
    blocks.nearest[i] = measured if measured > 0.0 else FAR
    blocks.farthest[i] = measured
    blocks.mean[i] = measured
    blocks.level[i] = 0 if measured > 0.0 else -1
    blocks.group[i] = 0


@ti.func
def _has_rays(blocks: Template, i: I32):
    """True if a group with rays begins at pixel i."""
    return blocks.group[i] >= 0 and blocks.nearest[i] < FAR


@kernel
def _write_down(
    width: I32, height: I32, blocks: _PixelBlocks, first: I32Array, first_group: I32Array,
    rays: RayList, widest: I32Array,
) -> None:  # fmt: skip
    """List the groups that begin in each tile, and their rays, from its places ``first_group`` and ``first``
    (tiles) in the lists on. ``widest`` (tiles) receives the largest side of a group in pixels.
    """
    across = (width + TILE - 1) // TILE
    for iteration in range(first.shape[0] * SPREAD):
        if iteration % SPREAD == 0:
            tile = iteration // SPREAD
            left, top = tile % across * TILE, tile // across * TILE
            ray, group, highest = first[tile], first_group[tile], 0
            for v in range(top, ti.min(top + TILE, height)):
                for u in range(left, ti.min(left + TILE, width)):
                    corner = v * width + u
                    if _has_rays(blocks, corner):
                        level = blocks.group[corner]
                        columns = (level + 1) // 2  # their number's logarithm
                        rays.groups[group] = (corner << BITS) + level
                        rays.first[group] = ray
                        for k in range(1 << level):
                            i = corner + (k >> columns) * width + (k & ((1 << columns) - 1))
                            if blocks.level[i] >= 0:
                                rays.blocks[ray] = (i << BITS) + blocks.level[i]
                                rays.depth[ray] = blocks.mean[i]
                                ray += 1
                        highest = ti.max(highest, level)
                        group += 1
                        rays.first[group] = ray  # the last one's end; others are written again
            widest[tile] = 1 << (highest + 1) // 2


@kernel
def _find_reach(rays: RayList, sensor: Sensor, end_sigmas: F32) -> None:
    """The depths at which rays end, and those before which none of a group can meet its surface."""
    for group in range(rays.group_number):
        before = FAR
        for i in range(rays.first[group], rays.first[group + 1]):
            measured, noise = rays.depth[i], block_noise(rays.blocks[i], sensor)
            # Both before anything is written: they have much in common.
            last = sensor.farthest_depth(measured, noise, end_sigmas)
            support = sensor.support(measured, noise)
            rays.last[i] = last
            before = ti.min(before, support)
        rays.support[group] = before
