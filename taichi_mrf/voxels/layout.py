"""The three levels of the map, and how a voxel is numbered.

A brick is 8^3 voxels, a chunk is 8^3 bricks. Voxel (i, j, k) of the world covers the half-open box
[i, i+1) x [j, j+1) x [k, k+1) times the voxel size; bricks and chunks are aligned to it. All of this
is integer arithmetic with floor division, so negative coordinates need no special case.
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.voxels.types import I32, IVec3

BRICK = 8
"""Voxels along each side of a brick."""

CHUNK = 8
"""Bricks along each side of a chunk."""

CHUNK_VOXELS = BRICK * CHUNK
"""Voxels along each side of a chunk."""

VOXELS = BRICK**3
"""Voxels in a brick."""


@ti.func
def voxel_number(cell: IVec3) -> I32:
    """Number (0..511) of a voxel in its brick, from its coordinates there (0..7)."""
    return (cell[0] * BRICK + cell[1]) * BRICK + cell[2]


@ti.func
def flat(cell: IVec3, shape: IVec3) -> I32:
    """Row-major number of a cell in a box of cells."""
    return (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]


def offsets_in_brick() -> NDArray[np.int32]:
    """(512, 3): the voxel of each number within a brick, the inverse of :func:`voxel_number`."""
    return np.stack(np.unravel_index(np.arange(VOXELS), (BRICK,) * 3), axis=1).astype(np.int32)
