"""The three levels of the map, and how a voxel is numbered.

A brick is 8^3 voxels, a chunk is 8^3 bricks. Voxel (i, j, k) of the world covers the half-open box
[i, i+1) x [j, j+1) x [k, k+1) times the voxel size; bricks and chunks are aligned to it. All of this
is integer arithmetic with floor division, so negative coordinates need no special case.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

BRICK = 8
"""Voxels along each side of a brick."""

CHUNK = 8
"""Bricks along each side of a chunk."""

CHUNK_VOXELS = BRICK * CHUNK
"""Voxels along each side of a chunk."""

CHUNK_BRICKS = CHUNK**3
"""Bricks in a chunk."""

VOXELS = BRICK**3
"""Voxels in a brick."""


def offsets_in_brick() -> NDArray[np.int32]:
    """(512, 3): the voxel of each number within a brick, the inverse of ``voxel_number``."""
    return np.stack(np.unravel_index(np.arange(VOXELS), (BRICK,) * 3), axis=1).astype(np.int32)


def split_bricks(dense: NDArray[Any]) -> NDArray[Any]:
    """Voxels of a box of whole bricks, (8 a, 8 b, 8 c) -> (a * b * c, 512)."""
    a, b, c = (side // BRICK for side in dense.shape)
    split = dense.reshape(a, BRICK, b, BRICK, c, BRICK).transpose(0, 2, 4, 1, 3, 5)
    return np.ascontiguousarray(split).reshape(-1, VOXELS)


def join_bricks(bricks: NDArray[Any], shape: tuple[int, int, int]) -> NDArray[Any]:
    """The inverse: bricks (a * b * c, 512) of a box of ``shape`` voxels."""
    a, b, c = (side // BRICK for side in shape)
    joined = bricks.reshape(a, b, c, BRICK, BRICK, BRICK).transpose(0, 3, 1, 4, 2, 5)
    return joined.reshape(shape)


def grid_keys(cells: NDArray[np.integer] | NDArray[np.floating]) -> NDArray[np.int64]:
    """A number for each cell of a grid, whole coordinates (n, 3) -> (n,), ascending in x, then y, then z.

    It distinguishes cells within 2^20 of the origin: bricks, and voxels or other cells as well.
    """
    i, j, k = (cells.astype(np.int64) + (1 << 20)).T
    return (i << 42) | (j << 21) | k


def rows_around(cells: NDArray[np.int32], keys: NDArray[np.int64], reach: int = 1) -> NDArray[np.int32]:
    """Index among ascending ``keys`` (:func:`grid_keys`) of cells (n, 3) and of those up to ``reach`` away
    along each axis: (n, (2 reach + 1)^3), x slowest, -1 where there is none."""
    side = 2 * reach + 1
    rows = np.full((len(cells), side**3), -1, np.int32)
    if not len(keys):
        return rows
    lowest = grid_keys(cells - reach)
    for column in range(side * side):
        # Ascending keys have the cells of a column in a row: only the first one is searched for.
        wanted = lowest + ((column // side << 42) + (column % side << 21))
        place = np.searchsorted(keys, wanted)
        for k in range(side):
            here = np.minimum(place, len(keys) - 1)
            found = keys[here] == wanted + k
            rows[found, column * side + k] = here[found]
            place = place + found
    return rows


def by_chunk(bricks: NDArray[np.int32]) -> Iterator[tuple[tuple[int, int, int], NDArray[np.int64]]]:
    """The chunks that bricks (n, 3) lie in, each with the rows of its bricks."""
    chunks, owner = np.unique(bricks // CHUNK, axis=0, return_inverse=True)
    order = np.argsort(owner.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(owner.reshape(-1), minlength=len(chunks)))
    for number, (x, y, z) in enumerate(chunks.tolist()):
        yield (x, y, z), order[ends[number - 1] if number else 0 : ends[number]]
