"""Signed distances from a surface for the voxels of some bricks, as sums over measurements."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.voxels.layout import BRICK, CHUNK, VOXELS, grid_keys

Sums = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Weights, and distances and excesses times weight."""

VALUES = 3
"""How many sums a voxel has."""


class DistanceSource(Protocol):
    """Where signed distances are read from, a box at a time: memory, or a map in chunks."""

    @property
    def chunks(self) -> NDArray[np.int32]:
        """The chunks (n, 3) that hold distances."""
        ...

    def box(self, first: NDArray[np.int64], side: int) -> Sums:
        """The sums, (side, side, side) each, of the voxels from ``first`` (3,) on; 0 where there are none."""
        ...


@dataclass(frozen=True)
class DistanceField:
    """``bricks`` (n, 3) ascending, and for their voxels ``weight`` (n, 512), ``distance`` (n, 512) in voxels
    times weight, positive in front of the surface, and ``excess`` (n, 512) in voxels^2 times weight, the
    square of the distance less the variance of its noise. A weight of 1 is that of a pixel whose standard
    deviation is far below the voxel size; one of standard deviation s, in voxels, has 1 / (16 s^2 + 1)."""

    bricks: NDArray[np.int32]
    weight: NDArray[np.float32]
    distance: NDArray[np.float32]
    excess: NDArray[np.float32]

    @property
    def sums(self) -> NDArray[np.float32]:
        """All three, (n, 512, VALUES)."""
        return np.stack([self.weight, self.distance, self.excess], axis=-1)

    @staticmethod
    def of(bricks: NDArray[np.int32], sums: NDArray[np.float32]) -> "DistanceField":
        """From bricks (n, 3) and their :attr:`sums` (n, 512, VALUES)."""
        return DistanceField(bricks, sums[..., 0], sums[..., 1], sums[..., 2])

    @property
    def chunks(self) -> NDArray[np.int32]:
        """The chunks (n, 3) that hold distances."""
        chunks = self.bricks // CHUNK
        return chunks[np.unique(grid_keys(chunks), return_index=True)[1]]

    def box(self, first: NDArray[np.int64], side: int) -> Sums:
        """The sums, (side, side, side) each, of the voxels from ``first`` (3,) on; 0 where there are none."""
        lowest = first // BRICK
        shape = (first + side - 1) // BRICK - lowest + 1
        bricks = np.indices(tuple(shape.tolist())).reshape(3, -1).T + lowest
        wanted = grid_keys(bricks)
        rows = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        here = np.flatnonzero(self._keys[rows] == wanted) if len(self._keys) else np.zeros(0, np.int64)
        cut = tuple(slice(a, a + side) for a in (first - lowest * BRICK).tolist())
        boxes = []
        for sums in (self.weight, self.distance, self.excess):
            box = np.zeros((len(bricks), VOXELS), np.float32)
            box[here] = sums[rows[here]]
            dense = box.reshape(*shape, *(BRICK,) * 3).transpose(0, 3, 1, 4, 2, 5)
            boxes.append(np.ascontiguousarray(dense.reshape(shape * BRICK)[cut]))
        return boxes[0], boxes[1], boxes[2]

    @cached_property
    def _keys(self) -> NDArray[np.int64]:
        return grid_keys(self.bricks)
