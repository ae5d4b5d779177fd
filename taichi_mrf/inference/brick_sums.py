"""Integer sums for the voxels of some bricks: what frozen keyframes leave, the same in whatever order."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.voxels.layout import CHUNK, VOXELS, grid_keys

LARGEST = 1 << 30
"""No sum goes beyond this, on either side of 0: the sums of a voxel shrink together, so that their ratios
stay. Only then does it matter in which order they were added."""

VOTES = 2
"""Numbers of a voxel among votes: its votes and its score (surface_votes.py)."""


@dataclass(frozen=True)
class BrickSums:
    """``bricks`` (n, 3), ascending by their keys, each once; ``sums`` (n, 512, k) int32 of their voxels."""

    bricks: NDArray[np.int32]
    sums: NDArray[np.int32]

    @staticmethod
    def nothing(values: int) -> "BrickSums":
        """No bricks, with so many values a voxel."""
        return BrickSums(np.zeros((0, 3), np.int32), np.zeros((0, VOXELS, values), np.int32))

    @staticmethod
    def of(bricks: NDArray[np.int32], sums: NDArray[np.int32]) -> "BrickSums":
        """Those of distinct bricks in any order, without those whose sums are all 0."""
        rows = np.flatnonzero(sums.any(axis=(1, 2)))
        rows = rows[np.argsort(grid_keys(bricks[rows]))]
        return BrickSums(bricks[rows], sums[rows])

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.bricks.nbytes + self.sums.nbytes

    def plus(self, other: "BrickSums") -> "BrickSums":
        """Both together."""
        bricks = np.concatenate([self.bricks, other.bricks])
        _, first, row = np.unique(grid_keys(bricks), return_index=True, return_inverse=True)
        row = row.reshape(-1)
        sums = np.zeros((len(first), *self.sums.shape[1:]), np.int32)
        sums[row[: len(self.bricks)]] = self.sums
        mine = row[len(self.bricks) :]
        both = sums[mine].astype(np.int64) + other.sums
        largest = np.abs(both).max(axis=2, keepdims=True, initial=LARGEST)
        if (largest > LARGEST).any():
            both = np.rint(both * (LARGEST / largest)).astype(np.int64)
        sums[mine] = both
        return BrickSums(bricks[first], sums)

    def inside(self, chunks: NDArray[np.int32]) -> NDArray[np.bool_]:
        """True for the bricks that lie in some chunks (n, 3)."""
        return np.isin(grid_keys(self.bricks // CHUNK), grid_keys(chunks))

    def chosen(self, rows: NDArray[np.bool_]) -> "BrickSums":
        """Those of some bricks, a mask (n,)."""
        return BrickSums(self.bricks[rows], self.sums[rows])
