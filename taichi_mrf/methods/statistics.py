"""The size of a map in numbers that can be compared between mapping methods."""

from dataclasses import dataclass

import numpy as np

from taichi_mrf.voxels.layout import CHUNK, VOXELS
from taichi_mrf.voxels.pool import BrickPool


@dataclass(frozen=True)
class MapStatistics:
    """The size of a map. ``memory_mb`` counts voxels, messages, images and scratch memory;
    ``bytes_per_voxel`` what grows with the voxels: their channels and all keyframes' messages."""

    keyframes: int
    frozen: int
    rays: int
    bricks: int
    voxels: int
    chunks: int
    memory_mb: float
    bytes_per_voxel: float


def measure(
    pool: BrickPool, *, keyframes: int, frozen: int, rays: int, message_bytes: int, other_bytes: int
) -> MapStatistics:
    """The statistics of a map; ``message_bytes`` is the memory of all messages, ``other_bytes`` what does not
    grow with the voxels."""
    in_use = pool.in_use
    voxels = len(in_use) * VOXELS
    of_voxels = pool.capacity * VOXELS * pool.bytes_per_voxel + message_bytes
    return MapStatistics(
        keyframes=keyframes,
        frozen=frozen,
        rays=rays,
        bricks=len(in_use),
        voxels=voxels,
        chunks=len(np.unique(pool.bricks[in_use] // CHUNK, axis=0)),
        memory_mb=(of_voxels + other_bytes) / 1e6,
        bytes_per_voxel=of_voxels / max(voxels, 1),
    )
