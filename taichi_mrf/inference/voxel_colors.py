"""The colour of each voxel: what the pixels saw, by the posterior that they saw this voxel (pixel_pass.py).

With a pixel's colour c_r,    colour_i = sum_r w_ri c_r / sum_r w_ri.

A keyframe's mean colour in a voxel is rounded to 8 bits, and so is its weight, the number of pixels that saw
the voxel, MOST_PIXELS at most: near views do not outvote all others. The sums of a voxel are red and green
times weight in the halves of the first word, blue times weight and weight in those of the second.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.accumulators import low_half
from taichi_mrf.inference.pixel_pass import PixelVisitor, add_pair
from taichi_mrf.inference.ray_list import block_of
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, I32Array, I64Array, Template, Vec4

MOST_PIXELS = 32.0
"""A keyframe's weight in a voxel stops growing at so many pixels."""

WEIGHT_STEPS = 255.0 / MOST_PIXELS
"""Steps of the weight for each pixel."""


@dataclass(frozen=True)
class ColorVisitor(PixelVisitor):
    """Adds the colours of rays' pixels to the voxels that they see."""

    @staticmethod
    def packed(image: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Red + 256 green + 65536 blue, 0 for no colour."""
        wide = image.reshape(-1, 3).astype(np.int32)
        return wide[:, 0] | wide[:, 1] << 8 | wide[:, 2] << 16

    @ti.func
    def read(self, block: I32):
        """Sums of red, green and blue over the pixels that have a colour, and their number."""
        u, v, wide, high = block_of(block, self.width)
        sums = Vec4(0.0)
        for row in range(v, v + high):
            for column in range(u, u + wide):
                packed = self.image[row * self.width + column]
                if packed != 0:
                    sums += Vec4(packed & 255, packed >> 8 & 255, packed >> 16 & 255, 1.0)
        return sums

    @ti.func
    def give(self, voxel: I32, unit: F32, said: Template):
        weight = ti.cast(unit * said[3] + 0.5, ti.i64)
        if weight > 0:
            # As shares of the rounded weight, so that the mean lies between the colours.
            share = ti.cast(weight, ti.f32) / said[3]
            add_pair(self.sums, 2 * voxel, share * said[0], share * said[1])
            ti.atomic_add(self.sums[2 * voxel + 1], (ti.cast(share * said[2] + 0.5, ti.i64) << 32) + weight)

    @ti.func
    def finish(self, voxel: I32):
        red, green, blue, weight = _means(self.sums, voxel)
        if weight > 0:
            steps = ti.cast(ti.min(255.0, ti.cast(weight, ti.f32) / self.scale * WEIGHT_STEPS + 0.5), ti.i64)
            self.sums[2 * voxel] = (red * steps << 32) + green * steps
            self.sums[2 * voxel + 1] = (blue * steps << 32) + steps

    @staticmethod
    def values(sums: Any) -> NDArray[np.uint8]:
        """Red, green, blue, and the weight, at most 255; 0 for none."""
        packed = np.zeros(sums.shape[0] // 2, np.int32)
        _pack(sums, packed)
        runtime.settle()
        return packed.view(np.uint8).reshape(-1, 4)


@ti.func
def _means(sums: Template, voxel: I32):
    """A voxel's red, green and blue, rounded, and its weight; 0 without a weight."""
    rg, bw = sums[2 * voxel], sums[2 * voxel + 1]
    weight = low_half(bw)
    half, red, green, blue = weight // 2, ti.i64(0), ti.i64(0), ti.i64(0)
    if weight > 0:
        red, green = ((rg >> 32) + half) // weight, (low_half(rg) + half) // weight
        blue = ((bw >> 32) + half) // weight
    return red, green, blue, weight


@ti.kernel
def _pack(sums: I64Array, packed: I32Array):
    """Mean colours and weights of the sums (n * 2): red, green, blue, weight from the lowest byte on."""
    for i in range(packed.shape[0]):
        red, green, blue, weight = _means(sums, i)
        packed[i] = ti.cast(red + (green << 8) + (blue << 16) + (ti.min(weight, 255) << 24), ti.i32)
