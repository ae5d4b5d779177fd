"""Writes a map in memory to a store, layer by layer."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.export.chunk_store import ChunkStore, StoreHeader, new_store
from taichi_mrf.geometry.up import Up
from taichi_mrf.queries.known_bricks import BrickReader, Bricks, known_bricks
from taichi_mrf.queries.voxel_map import PixelValues, VoxelMap
from taichi_mrf.voxels.calls import calls_of
from taichi_mrf.voxels.layers import (
    FIRST,
    LOG_ODDS,
    SURFACE,
    BrickValues,
    known_log_odds,
)
from taichi_mrf.voxels.layout import CHUNK, CHUNK_VOXELS, by_chunk


def header_of(m: VoxelMap, up: Up | None = None) -> StoreHeader:
    """The header of a map's store; ``up`` (default: the map's) is kept in it."""
    prior, volume = m.view.pool.prior_log_odds, m.view.volume
    return StoreHeader.of(m.config, prior, m.seen_free_log_odds, volume.min_evidence, up or m.up)


def write_chunks(
    path: str | Path,
    m: VoxelMap,
    up: Up | None = None,
    fed: Mapping[str, PixelValues] = MappingProxyType({}),
    measured: VoxelMap | None = None,
) -> None:
    """Write a map in memory to a store, chunk by chunk; ``up`` (default: the map's) is kept in it, the layers
    ``fed`` by pixels, what the rays of ``measured`` (the same map or None) say of the surface, and which
    voxels are occupied beyond their marginals.
    Raises MapFileError, TaichiMRFError without zarr."""
    reader, header = BrickReader(m), header_of(m, up)
    deciding = None if m.decided is m else BrickReader(m.decided)
    known = m.view.pool.prior_log_odds, m.view.volume.min_evidence

    def layers_of(bricks: Bricks) -> dict[str, BrickValues]:
        log_odds = reader.log_odds(bricks)
        found: dict[str, NDArray] = {LOG_ODDS: known_log_odds(log_odds, header.prior_log_odds)}
        found |= {name: layer.within(reader.slots(bricks)) for name, layer in fed.items()}
        if deciding is not None:
            found[FIRST] = calls_of(deciding.log_odds(bricks), log_odds, *known)
        return {name: BrickValues(bricks, values) for name, values in found.items()}

    bricks = known_bricks(m)
    surface = None if measured is None else measured.surface_field()
    places = np.zeros((0, 3), np.int32) if surface is None else surface.chunks
    kept = (*fed.items(), (SURFACE, surface), (FIRST, deciding))
    with new_store(path) as folder:
        chunks = np.unique(np.concatenate([bricks // CHUNK, places]), axis=0)
        layers = [name for name, each in kept if each is not None]
        store = ChunkStore.create(folder, header, chunks, layers=layers)
        for _, rows in by_chunk(bricks):
            store.write(layers_of(bricks[rows]))
        for x, y, z in places.tolist():
            assert surface is not None
            sums = surface.box(np.array((x, y, z), np.int64) * CHUNK_VOXELS, CHUNK_VOXELS)
            store.write({SURFACE: BrickValues.of_chunk((x, y, z), np.stack(sums, axis=-1))})
        store.fill(chunks)
