"""Signed distances from a surface for the voxels of some bricks, as sums over measurements.

Where few rays have crossed a voxel, as far away or at small voxels, its mean distance is noise. There the
field is blended with its surroundings: with g = t / (t + W), a voxel of weight W takes g times the sums of
the 27 voxels around it (binomial weights) to its own, so a voxel that many rays have crossed stays as it is.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.voxels.layers import LAYERS, SURFACE, BrickValues
from taichi_mrf.voxels.layout import BRICK, CHUNK, VOXELS, grid_keys, rows_around

Sums = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Weights, and distances and excesses times weight."""

VALUES = LAYERS[SURFACE].width
"""Number of sums of a voxel."""

BLENDED_BELOW = 0.3
"""t: the weight at which a voxel's mean distance has a standard deviation of about half a voxel."""

LEAST_WEIGHT = 0.02
"""A voxel with less has no distance, nor has one that no ray has crossed."""

MARGIN = 1
"""Voxels around a box that blending reads."""


class DistanceSource(Protocol):
    """Source of signed distances, read a box at a time: memory, or a map in chunks."""

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
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.bricks.nbytes + self.weight.nbytes + self.distance.nbytes + self.excess.nbytes

    @property
    def sums(self) -> NDArray[np.float32]:
        """All three, (n, 512, VALUES)."""
        return np.stack([self.weight, self.distance, self.excess], axis=-1)

    @property
    def values(self) -> BrickValues:
        """All three as a layer."""
        return BrickValues(self.bricks, self.sums)

    @staticmethod
    def of(bricks: NDArray[np.int32], sums: NDArray[np.float32]) -> "DistanceField":
        """From bricks (n, 3) and their :attr:`sums` (n, 512, VALUES)."""
        return DistanceField(bricks, *(np.ascontiguousarray(sums[..., i]) for i in range(VALUES)))

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

    def rows_around(self) -> NDArray[np.int32]:
        """The rows of the 27 bricks in and around each, (n, 27), x slowest; -1 where there is none."""
        return rows_around(self.bricks, self._keys)

    @cached_property
    def _keys(self) -> NDArray[np.int64]:
        return grid_keys(self.bricks)


def blended_sums(weight: NDArray[np.float32], *sums: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Sums of weight, and others, of a box (a, b, c) of voxels, blended with their surroundings; the box
    shrinks by MARGIN on each side."""
    inner = (slice(MARGIN, -MARGIN),) * 3
    share = BLENDED_BELOW / (BLENDED_BELOW + weight[inner])
    return [each[inner] + share * _binomial(each) for each in (weight, *sums)]


def _binomial(sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each voxel and its neighbours with the weights 1/2, 1, 1/2 along each axis."""
    for axis in range(3):
        sums = np.moveaxis(sums, axis, 0)
        sums = np.moveaxis(sums[1:-1] + 0.5 * (sums[:-2] + sums[2:]), 0, axis)
    return sums
