"""The layers of a map: named values of each voxel, and the one table that says what they are.

Maps in chunks, windows and submaps hold the layers that a map has, and loop over the table to write, move and
read them. A new layer is an entry here, and a value where its source is read (export/chunk_blocks.py for maps
in memory).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, VOXELS, by_chunk, grid_keys, split_bricks

Chunk = tuple[int, int, int]
"""Coordinates of a chunk."""


@dataclass(frozen=True)
class Layer:
    """The ``dtype`` of a voxel's values, how many there are (``width``), and the value that is ``missing``
    where nothing is known."""

    dtype: str
    width: int
    missing: float
    about: str

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one voxel's values: none for a width of 1."""
        return (self.width,) if self.width > 1 else ()

    @property
    def chunk_shape(self) -> tuple[int, ...]:
        """The shape of a chunk's values."""
        return (CHUNK_VOXELS, CHUNK_VOXELS, CHUNK_VOXELS, *self.shape)


LOG_ODDS, COLORS, SURFACE, FIRST = "log_odds", "colors", "surface", "first_surface"

LAYERS = {
    LOG_ODDS: Layer("float32", 1, np.nan, "log-odds of being occupied"),
    COLORS: Layer("uint8", 4, 0, "red, green, blue, and how much was seen"),
    SURFACE: Layer("float32", 3, 0, "weight, and distance and excess times weight (DistanceField)"),
    FIRST: Layer("uint8", 1, 0, "what rays say beyond the marginal (calls.py)"),
}
"""Every map has log-odds; the others are there if it has them."""


@dataclass(frozen=True)
class BrickValues:
    """Values of a layer: ``bricks`` (n, 3), each once, and ``values`` (n, 512) of their voxels, with a last
    axis for a layer of more than one."""

    bricks: NDArray[np.int32]
    values: NDArray

    @staticmethod
    def of_chunk(chunk: Chunk, block: NDArray) -> "BrickValues":
        """Those of a chunk's bricks, from its block (64, 64, 64), with a last axis for a layer of more."""
        bricks = np.indices((CHUNK,) * 3).reshape(3, -1).T + np.array(chunk) * CHUNK
        layers = block.reshape(*block.shape[:3], -1)
        values = np.stack([split_bricks(layers[..., i]) for i in range(layers.shape[3])], axis=-1)
        return BrickValues(bricks.astype(np.int32), values.reshape(*values.shape[:2], *block.shape[3:]))

    def chosen(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "BrickValues":
        """Those of some bricks: a mask (n,), or numbers of rows."""
        return BrickValues(self.bricks[rows], self.values[rows])

    def in_chunks(self, chunks: NDArray[np.int32]) -> "BrickValues":
        """Those of the bricks in some chunks, (n, 3)."""
        return self.chosen(np.isin(grid_keys(self.bricks // CHUNK), grid_keys(chunks)))


Layers = Mapping[str, BrickValues]
"""Values by the names of their layers."""


def known_log_odds(log_odds: NDArray[np.float32], prior_log_odds: float) -> NDArray[np.float32]:
    """Log-odds as a layer: NaN for voxels that hold the prior, which are unknown."""
    return np.where(log_odds == np.float32(prior_log_odds), np.float32(np.nan), log_odds)


def chunk_blocks(layer: Layer, found: BrickValues) -> Iterator[tuple[Chunk, NDArray]]:
    """The blocks (64, 64, 64) of the chunks that some bricks lie in, with a last axis for a layer of more
    than one value."""
    for chunk, rows in by_chunk(found.bricks):
        block = np.full((CHUNK, BRICK, CHUNK, BRICK, CHUNK, BRICK, *layer.shape), layer.missing, layer.dtype)
        x, y, z = (found.bricks[rows] - np.array(chunk) * CHUNK).T
        block[x, :, y, :, z, :] = found.values[rows].reshape(-1, BRICK, BRICK, BRICK, *layer.shape)
        yield chunk, block.reshape(layer.chunk_shape)


def of_voxels(bricks: NDArray[np.int32], numbers: NDArray[np.int32], values: NDArray) -> BrickValues:
    """Values of some voxels, (n, ...), which are given by their bricks (n, 3) and their ``numbers`` in these;
    0 for the other voxels of the bricks."""
    keys, first, row = np.unique(grid_keys(bricks), return_index=True, return_inverse=True)
    dense = np.zeros((len(keys), VOXELS, *values.shape[1:]), values.dtype)
    dense[row.reshape(-1), numbers] = values
    return BrickValues(bricks[first], dense)
