"""The signed distances in the store of a map in chunks, read chunk by chunk."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.export.chunk_store import ChunkStore
from taichi_mrf.voxels.distance_field import VALUES, DistanceField, Sums
from taichi_mrf.voxels.layers import SURFACE, Chunk
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS, split_bricks

_HELD = 64
"""Chunks whose distances are in memory together, 3 MB each."""


class StoredDistances:
    """The signed distances in a store with these ``chunks`` (n, 3) from the voxel ``first`` up to, but
    without, ``after``, (3,) each: 0 outside."""

    def __init__(
        self,
        store: ChunkStore,
        chunks: NDArray[np.int32],
        first: NDArray[np.int64],
        after: NDArray[np.int64],
    ) -> None:
        self.first, self.after = first, after
        inside = (chunks >= first // CHUNK_VOXELS) & (chunks <= (after - 1) // CHUNK_VOXELS)
        self._chunks = chunks[inside.all(axis=1)]
        self._known = set(map(tuple, self._chunks.tolist()))
        self._read = lru_cache(_HELD)(lambda chunk: store.read(SURFACE, chunk))

    @property
    def chunks(self) -> NDArray[np.int32]:
        """The chunks (n, 3) that may hold distances."""
        return self._chunks

    def box(self, first: NDArray[np.int64], side: int) -> Sums:
        """The sums, (side, side, side) each, of the voxels from ``first`` (3,) on; 0 where there are none."""
        sums = np.zeros((side, side, side, VALUES), np.float32)
        begin, end = np.maximum(first, self.first), np.minimum(first + side, self.after)
        if (begin < end).all():
            lowest, highest = begin // CHUNK_VOXELS, (end - 1) // CHUNK_VOXELS
            for step in np.ndindex(*(highest - lowest + 1).tolist()):
                chunk = lowest + step
                if tuple(chunk.tolist()) in self._known:
                    corner = chunk * CHUNK_VOXELS
                    low, high = np.maximum(begin, corner), np.minimum(end, corner + CHUNK_VOXELS)
                    sums[_between(low - first, high - first)] = self._read(_key(chunk))[
                        _between(low - corner, high - corner)
                    ]
        weight, distance, excess = (np.ascontiguousarray(sums[..., i]) for i in range(VALUES))
        return weight, distance, excess

    def field(self) -> DistanceField:
        """All of them in memory, of the bricks that have some. ``first`` and ``after`` must be borders of
        bricks, as far apart along each axis."""
        sides = (self.after - self.first).tolist()
        sums = np.stack([split_bricks(each) for each in self.box(self.first, sides[0])], axis=-1)
        bricks = np.indices([side // BRICK for side in sides]).reshape(3, -1).T + self.first // BRICK
        some = sums[..., 0].any(axis=1)
        return DistanceField.of(bricks[some].astype(np.int32), sums[some])


def _between(low: NDArray[np.int64], high: NDArray[np.int64]) -> tuple[slice, ...]:
    return tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))


def _key(chunk: NDArray[np.int64]) -> Chunk:
    x, y, z = chunk.tolist()
    return x, y, z
