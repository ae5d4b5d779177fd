"""The surface of a map in chunks, made from the signed distances in its store, some chunks at a time."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.export.chunk_store import Chunk
from taichi_mrf.export.fused_surface import FusedSurface, fused_surface, within_voxels, without_free
from taichi_mrf.export.store_header import SURFACE
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.mrf.surfacing import LEAST
from taichi_mrf.queries.colored import ColoredMap, blended_colors
from taichi_mrf.voxels.distance_field import Sums
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS

MARGIN = BRICK
"""Voxels around a box from which its surface is made too, before it is cut: more than any vertex's position,
normal and standard deviation depend on."""

_HELD = 64
"""Chunks whose distances are in memory together, 2 MB each."""


class StoredDistances:
    """The signed distances of a map in chunks from the voxel ``first`` up to, but without, ``after``, (3,)
    each: 0 outside."""

    def __init__(self, source: ChunkedMap, first: NDArray[np.int64], after: NDArray[np.int64]) -> None:
        self.first, self.after = first, after
        chunks = source.chunks
        inside = (chunks >= first // CHUNK_VOXELS) & (chunks <= (after - 1) // CHUNK_VOXELS)
        self._chunks = chunks[inside.all(axis=1)]
        self._known = set(map(tuple, self._chunks.tolist()))
        self._read = lru_cache(_HELD)(lambda chunk: source.store.read_extra(SURFACE, chunk))

    @property
    def chunks(self) -> NDArray[np.int32]:
        """The chunks (n, 3) that may hold distances."""
        return self._chunks

    def box(self, first: NDArray[np.int64], side: int) -> Sums:
        """The sums, (side, side, side) each, of the voxels from ``first`` (3,) on; 0 where there are none."""
        sums = np.zeros((side, side, side, 2), np.float32)
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
        return np.ascontiguousarray(sums[..., 0]), np.ascontiguousarray(sums[..., 1])


def stored_surface(
    source: ChunkedMap, first: NDArray[np.int64], after: NDArray[np.int64], colored: ColoredMap | None
) -> FusedSurface:
    """The surface in the cells of the voxels from ``first`` up to, but without, ``after``, (3,) each; the
    surfaces of adjoining boxes meet without a seam. ``colored`` gives its colours. Raises ConfigError for a
    map that holds no distances, TaichiMRFError without scikit-image."""
    if not source.has_surface:
        raise ConfigError(
            f"{source.store.path}: holds no measured surface: map the recording anew with --keep-surface, or "
            "export from the map.npz of a run"
        )
    distances = StoredDistances(source, first - MARGIN, after + MARGIN)
    found = without_free(source, fused_surface(distances, source.voxel_size), LEAST * source.prior)
    found = within_voxels(found, source.voxel_size, first, after)
    return found if colored is None else replace(found, colors=blended_colors(colored, found.vertices_m))


def _between(low: NDArray[np.int64], high: NDArray[np.int64]) -> tuple[slice, ...]:
    return tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))


def _key(chunk: NDArray[np.int64]) -> Chunk:
    x, y, z = chunk.tolist()
    return x, y, z
