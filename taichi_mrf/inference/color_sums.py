"""Sums of colours over keyframes, voxel by voxel, as integers: the same in whatever order they are added.

A keyframe's mean colour in a voxel is rounded to 8 bits, and so is its weight, the number of pixels that saw
the voxel, MOST_PIXELS at most: near views do not outvote all others. So a keyframe's share can be kept when
its images are dropped.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.accumulators import low_half
from taichi_mrf.kernels.resident import Resident
from taichi_mrf.kernels.types import F32, I32, I32Array, I64Array, Template
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layers import BrickValues, of_voxels
from taichi_mrf.voxels.layout import VOXELS, grid_keys
from taichi_mrf.voxels.numbering import strip_begin, strip_length
from taichi_mrf.voxels.pool import BrickPool

MOST_PIXELS = 32.0
"""A keyframe's weight in a voxel stops growing at so many pixels."""

WEIGHT_STEPS = 255.0 / MOST_PIXELS
"""Steps of the weight for each pixel."""

_MOST_WEIGHT = 1 << 22
"""Nothing is added to a voxel's sums beyond this weight, which 16,000 keyframes reach: they have 31 bits."""

_BYTES_PER_VOXEL = 20
"""Of the sums and of the colours."""


class ColorSums:
    """Sums over keyframes for the voxels of a pool: red and green times weight in the halves of ``rg``, blue
    times weight and weight in those of ``bw``, (capacity * 512) int64 each."""

    def __init__(self, pool: BrickPool) -> None:
        """Raises CapacityError if there is not enough memory."""
        self.capacity = pool.capacity
        cells = max(1, pool.capacity) * VOXELS
        check_memory(float(_BYTES_PER_VOXEL) * cells, f"the colours of {cells / 1e6:.3g} million voxels")
        self.rg, self.bw = ti.ndarray(ti.i64, cells), ti.ndarray(ti.i64, cells)
        self.rg.fill(0)
        self.bw.fill(0)

    def add_keyframe(self, slots: Resident, rg: "ti.Ndarray", bw: "ti.Ndarray") -> None:
        """Add a keyframe's :func:`weigh`-ed sums (n * 512) in the bricks in ``slots`` (n)."""
        _add_all(slots, rg, bw, self.rg, self.bw, strip_length())

    def add(self, share: "ColorShare", slots: NDArray[np.int32]) -> None:
        """Add what keyframes have left in some voxels; ``slots`` (n,) are the places of their bricks."""
        if len(slots):
            places = (slots * VOXELS + share.numbers).astype(np.int32)
            _add_share(places, share.rg, share.bw, self.rg, self.bw)

    def colors(self) -> NDArray[np.uint8]:
        """(capacity * 512, 4): red, green, blue, and the weight, at most 255; 0 for none."""
        packed = np.zeros(self.rg.shape[0], np.int32)
        _pack(self.rg, self.bw, packed)
        runtime.settle()
        return packed.view(np.uint8).reshape(-1, 4)


@dataclass(frozen=True)
class ColorShare:
    """Contribution of one or more keyframes to voxels: ``bricks`` (n, 3) and ``numbers`` (n,) of the voxels,
    each once, and their sums ``rg`` and ``bw`` (n,) as ColorSums has them."""

    bricks: NDArray[np.int32]
    numbers: NDArray[np.int32]
    rg: NDArray[np.int64]
    bw: NDArray[np.int64]

    @staticmethod
    def nothing() -> "ColorShare":
        """No voxels."""
        numbers, sums = np.zeros(0, np.int32), np.zeros(0, np.int64)
        return ColorShare(np.zeros((0, 3), np.int32), numbers, sums, sums)

    def chosen(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "ColorShare":
        """Those of some voxels: a mask (n,), or numbers of rows."""
        return ColorShare(self.bricks[rows], self.numbers[rows], self.rg[rows], self.bw[rows])

    @property
    def values(self) -> BrickValues:
        """The colours as a layer."""
        return of_voxels(self.bricks, self.numbers, self.colors())

    def colors(self) -> NDArray[np.uint8]:
        """The voxels' mean colours, (n, 4): red, green, blue, and the weight, at most 255."""
        weight = self.bw & 0xFFFFFFFF
        sums = (self.rg >> 32, self.rg & 0xFFFFFFFF, self.bw >> 32)
        means = [(each + weight // 2) // weight for each in sums]
        return np.stack([*means, np.minimum(weight, 255)], axis=1).astype(np.uint8)

    def plus(self, other: "ColorShare") -> "ColorShare":
        """Both together."""
        bricks = np.concatenate([self.bricks, other.bricks])
        numbers = np.concatenate([self.numbers, other.numbers])
        order = np.lexsort((numbers, grid_keys(bricks)))
        bricks, numbers = bricks[order], numbers[order]
        new = np.append(True, (np.diff(numbers) != 0) | (np.diff(bricks, axis=0) != 0).any(axis=1))
        first = np.flatnonzero(new[: len(numbers)])
        both = ((self.rg, other.rg), (self.bw, other.bw))
        rg, bw = (np.add.reduceat(np.concatenate(pair)[order], first) for pair in both)
        return ColorShare(bricks[first], numbers[first], rg, bw)


@ti.kernel
def weigh(cells: I32, rg: I64Array, bw: I64Array, scale: F32):
    """Replace the sums of a keyframe by its rounded mean colour times its rounded weight; arrays (cells)."""
    for i in range(cells):
        weight = low_half(bw[i])
        steps = ti.cast(ti.min(255.0, ti.cast(weight, ti.f32) / scale * WEIGHT_STEPS + 0.5), ti.i64)
        if steps > 0:
            half = weight // 2
            red, green = ((rg[i] >> 32) + half) // weight, (low_half(rg[i]) + half) // weight
            blue = ((bw[i] >> 32) + half) // weight
            rg[i] = (red * steps << 32) + green * steps
            bw[i] = (blue * steps << 32) + steps
        else:
            rg[i] = 0
            bw[i] = 0


@ti.kernel
def _add_all(
    slots: I32Array, rg: I64Array, bw: I64Array, all_rg: I64Array, all_bw: I64Array, strip: Template
):
    """Add a keyframe's share ``rg`` and ``bw`` (n * 512) in the bricks in ``slots`` (n) to the sums (pool *
    512)."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            if bw[i + k] != 0 and low_half(all_bw[j + k]) < _MOST_WEIGHT:
                all_rg[j + k] += rg[i + k]
                all_bw[j + k] += bw[i + k]


@ti.kernel
def _add_share(places: I32Array, rg: I64Array, bw: I64Array, all_rg: I64Array, all_bw: I64Array):
    """Add shares ``rg`` and ``bw`` (n) to the sums (pool * 512) at ``places`` (n), each once."""
    for i in range(places.shape[0]):
        all_rg[places[i]] += rg[i]
        all_bw[places[i]] += bw[i]


@ti.kernel
def _pack(rg: I64Array, bw: I64Array, packed: I32Array):
    """Mean colours and weights of the sums (pool * 512): red, green, blue, weight from the lowest byte on."""
    for i in range(packed.shape[0]):
        weight, color = low_half(bw[i]), ti.i64(0)
        if weight > 0:
            half = weight // 2
            red, green = ((rg[i] >> 32) + half) // weight, (low_half(rg[i]) + half) // weight
            blue = ((bw[i] >> 32) + half) // weight
            alpha = ti.min(weight, 255)
            color = red + (green << 8) + (blue << 16) + (alpha << 24)
        packed[i] = ti.cast(color, ti.i32)
