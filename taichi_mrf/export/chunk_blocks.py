"""Assembles bricks to chunks of 64^3 voxels, and writes a map in memory to a store."""

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import Config
from taichi_mrf.export.chunk_store import Chunk, ChunkStore, StoreHeader, new_store
from taichi_mrf.export.fused_surface import SurfacedMap
from taichi_mrf.export.store_header import COLORS, FIRST, SURFACE
from taichi_mrf.geometry.up import Up
from taichi_mrf.queries.colored import ColoredMap
from taichi_mrf.queries.known_bricks import BrickReader, Bricks, QueriedMap, known_bricks
from taichi_mrf.queries.points import OCCUPIED, classify
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, by_chunk


def chunk_block(
    chunk: Chunk, bricks: Bricks, log_odds: NDArray[np.float32], prior_log_odds: float
) -> NDArray[np.float32]:
    """(64, 64, 64) log-odds of a chunk from those of its bricks, (n, 512). NaN for unknown voxels: outside
    the bricks, and where the log-odds equal the prior's."""
    log_odds = np.where(log_odds == np.float32(prior_log_odds), np.float32(np.nan), log_odds)
    return _assembled(chunk, bricks, log_odds[..., None], np.nan)[..., 0]


def extra_block(chunk: Chunk, bricks: Bricks, values: NDArray) -> NDArray:
    """(64, 64, 64, k) values of a chunk from those of its bricks, (n, 512, k); 0 outside the bricks."""
    return _assembled(chunk, bricks, values, 0)


def first_block(chunk: Chunk, bricks: Bricks, first: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(64, 64, 64, 1) of a chunk: 1 where the rays take a voxel of its bricks, (n, 512), for a surface."""
    return extra_block(chunk, bricks, first.astype(np.uint8)[..., None])


def voxel_block(chunk: Chunk, bricks: Bricks, numbers: NDArray[np.int32], values: NDArray) -> NDArray:
    """(64, 64, 64, k) values of a chunk from those of some voxels, (n, k), which are given by their bricks
    (n, 3) and their ``numbers`` in these; 0 elsewhere."""
    block = np.zeros((*(CHUNK_VOXELS,) * 3, values.shape[1]), values.dtype)
    local = np.stack(np.unravel_index(numbers, (BRICK,) * 3), axis=1)
    block[tuple(((bricks - np.array(chunk) * CHUNK) * BRICK + local).T)] = values
    return block


def _assembled(chunk: Chunk, bricks: Bricks, values: NDArray, missing: float) -> NDArray:
    each = values.shape[2]
    block = np.full((CHUNK, BRICK, CHUNK, BRICK, CHUNK, BRICK, each), missing, values.dtype)
    x, y, z = (bricks - np.array(chunk) * CHUNK).T
    block[x, :, y, :, z, :] = values.reshape(-1, BRICK, BRICK, BRICK, each)
    return block.reshape((*(CHUNK_VOXELS,) * 3, each))


class StorableMap(QueriedMap, Protocol):
    """A map in memory that can be written to a store."""

    @property
    def config(self) -> Config: ...

    @property
    def seen_free_log_odds(self) -> float:
        """Log-odds of a place that rays cross but that has no brick."""
        ...


def header_of(m: StorableMap, up: Up | None = None) -> StoreHeader:
    """The header of a map's store; ``up`` (default: the map's) is kept in it."""
    prior, volume = m.view.pool.prior_log_odds, m.view.volume
    return StoreHeader.of(m.config, prior, m.seen_free_log_odds, volume.min_evidence, up or m.up)


def write_chunks(
    path: str | Path,
    m: StorableMap,
    up: Up | None = None,
    colored: ColoredMap | None = None,
    measured: SurfacedMap | None = None,
) -> None:
    """Write a map in memory to a store, chunk by chunk; ``up`` (default: the map's) is kept in it, the
    colours of ``colored``, what the rays of ``measured`` say of the surface (both the same map or None), and
    which voxels are occupied beyond their marginals.
    Raises MapFileError, TaichiMRFError without zarr."""
    reader = BrickReader(m)
    bricks = known_bricks(m)
    places, surface = np.zeros((0, 3), np.int32), None
    if measured is not None:
        surface = measured.surface_field()
        places = surface.chunks
    deciding = None if m.decided is m else BrickReader(m.decided)
    kept = ((COLORS, colored), (SURFACE, surface), (FIRST, deciding))
    extras = [name for name, each in kept if each is not None]
    with new_store(path) as folder:
        header = header_of(m, up)
        chunks = np.unique(np.concatenate([bricks // CHUNK, places]), axis=0)
        store = ChunkStore.create(folder, header, chunks, extras=extras)
        for chunk, rows in by_chunk(bricks):
            log_odds = reader.log_odds(bricks[rows])
            store.write(chunk, chunk_block(chunk, bricks[rows], log_odds, header.prior_log_odds))
            if colored is not None:
                colors = colored.colors_in(reader.slots(bricks[rows]))
                store.write_extra(COLORS, chunk, extra_block(chunk, bricks[rows], colors))
            if deciding is not None:
                known = deciding.pool.prior_log_odds, m.view.volume.min_evidence
                decided, own = (classify(x, *known) for x in (deciding.log_odds(bricks[rows]), log_odds))
                found = (decided == OCCUPIED) & (own != OCCUPIED)
                store.write_extra(FIRST, chunk, first_block(chunk, bricks[rows], found))
        for x, y, z in places.tolist():
            assert surface is not None
            sums = surface.box(np.array((x, y, z), np.int64) * CHUNK_VOXELS, CHUNK_VOXELS)
            store.write_extra(SURFACE, (x, y, z), np.stack(sums, axis=-1))
