"""Shares of keyframes in voxels: integer sums, which do not depend on the order of addition.

Each voxel has some ``words``, int64 with a number in each half. A keyframe's contribution to a layer
(pixel_pass.py) is rounded to integers, so its share can be kept when its images are dropped.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.voxels.layers import BrickValues, of_voxels
from taichi_mrf.voxels.layout import CHUNK, grid_keys


@dataclass(frozen=True)
class VoxelShare:
    """Contribution of one or more keyframes to voxels: ``bricks`` (n, 3) and ``numbers`` (n,) of the voxels,
    each once, and their ``sums`` (n, words) as VoxelSums has them."""

    bricks: NDArray[np.int32]
    numbers: NDArray[np.int32]
    sums: NDArray[np.int64]

    @staticmethod
    def nothing(words: int) -> "VoxelShare":
        """No voxels."""
        return VoxelShare(np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros((0, words), np.int64))

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.bricks.nbytes + self.numbers.nbytes + self.sums.nbytes

    def chosen(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "VoxelShare":
        """Those of some voxels: a mask (n,), or numbers of rows."""
        return VoxelShare(self.bricks[rows], self.numbers[rows], self.sums[rows])

    def in_chunks(self, chunks: NDArray[np.int32], inside: bool = True) -> "VoxelShare":
        """The part of it in some chunks (n, 3), or the part outside of them."""
        return self.chosen(np.isin(grid_keys(self.bricks // CHUNK), grid_keys(chunks)) == inside)

    def values(self, of_sums: Callable[[NDArray[np.int64]], NDArray]) -> BrickValues:
        """The values of the layer, which PixelVisitor.values has of sums."""
        return of_voxels(self.bricks, self.numbers, of_sums(self.sums.reshape(-1)))

    def plus(self, other: "VoxelShare") -> "VoxelShare":
        """Both together."""
        bricks = np.concatenate([self.bricks, other.bricks])
        numbers = np.concatenate([self.numbers, other.numbers])
        order = np.lexsort((numbers, grid_keys(bricks)))
        bricks, numbers = bricks[order], numbers[order]
        new = np.append(True, (np.diff(numbers) != 0) | (np.diff(bricks, axis=0) != 0).any(axis=1))
        first = np.flatnonzero(new[: len(numbers)])
        sums = np.add.reduceat(np.concatenate([self.sums, other.sums])[order], first, axis=0)
        return VoxelShare(bricks[first], numbers[first], sums)
