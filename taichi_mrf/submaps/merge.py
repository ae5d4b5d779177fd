"""All submaps' cores as one map in chunks, put together one submap at a time."""

import math
from pathlib import Path

import numpy as np

from taichi_mrf.export.chunk_blocks import by_chunk, chunk_block
from taichi_mrf.export.chunk_store import ChunkStore, StoreHeader, new_store
from taichi_mrf.inference.prior import prior_probability
from taichi_mrf.submaps.job import Job
from taichi_mrf.submaps.round_files import read_core, read_places, round_path
from taichi_mrf.voxels.layout import CHUNK, VOXELS


def merge_submaps(folder: Path, job: Job, round: int, path: Path) -> None:
    """Write the map that a round has ended with to ``path``. A chunk belongs to one submap alone, so that
    each is written once, and no more than one submap's core is ever in memory. Raises MapFileError."""
    files = [round_path(folder, round, number) for number in range(len(job.plan.submaps))]
    prior = prior_probability(job.config.inference, job.config.voxel_size)
    header = StoreHeader.of(job.config, math.log(prior / (1 - prior)), job.config.volume.min_evidence)
    chunks = [np.unique(np.concatenate(read_places(file)) // CHUNK, axis=0) for file in files]
    with new_store(path) as place:
        store = ChunkStore.create(place, header, np.unique(np.concatenate(chunks), axis=0))
        for file in files:
            bricks, belief, free = read_core(file)
            empty = np.full((len(free), VOXELS), header.seen_free_log_odds, np.float32)
            bricks, belief = np.concatenate([bricks, free]), np.concatenate([belief, empty])
            for chunk, rows in by_chunk(bricks):
                block = chunk_block(chunk, bricks[rows], belief[rows], header.prior_log_odds)
                store.write(chunk, block)
