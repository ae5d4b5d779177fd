"""Frontiers: free voxels beside unknown ones, where exploration goes on (Yamauchi 1997), in clusters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.box import voxel_box
from taichi_mrf.queries.clusters import find_clusters
from taichi_mrf.queries.known_bricks import BrickReader, known_bricks, sorted_bricks
from taichi_mrf.queries.points import FREE, UNKNOWN
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels.layout import CHUNK, CHUNK_VOXELS


@dataclass(frozen=True)
class Frontiers:
    """Frontier voxels and their clusters, the largest first.

    ``points`` (N, 3) are the voxels' centres in metres, ``cluster`` (N,) int32 which cluster each belongs to;
    ``sizes`` (K,) int64 the clusters' numbers of voxels, ``centroids`` (K, 3) their means in metres.
    """

    points: NDArray[np.float64]
    cluster: NDArray[np.int32]
    sizes: NDArray[np.int64]
    centroids: NDArray[np.float64]


def find_frontiers(m: VoxelMap, min_voxels: int = 1) -> Frontiers:
    """All free voxels that share a face with an unknown one; those that touch, also at a corner, are one
    cluster. Clusters of less than ``min_voxels`` are left out.

    The map is looked at chunk by chunk, so that memory is bounded by what is found. Raises ConfigError for
    min_voxels below 1.
    """
    voxels = frontier_voxels(m)
    cluster, sizes = find_clusters(voxels, min_voxels)
    kept = cluster >= 0
    points, cluster = (voxels[kept].astype(np.float64) + 0.5) * m.voxel_size, cluster[kept]
    sums = [np.bincount(cluster, points[:, axis], len(sizes)) for axis in range(3)]
    return Frontiers(points, cluster, sizes, np.stack(sums, axis=1) / np.maximum(sizes, 1)[:, None])


def frontier_voxels(m: VoxelMap) -> NDArray[np.int32]:
    """Coordinates (n, 3) of the free voxels that share a face with an unknown one, ascending by chunk."""
    m = m.decided
    reader = BrickReader(m)
    found = [np.zeros((0, 3), np.int32)]
    for chunk in sorted_bricks(known_bricks(m) // CHUNK).astype(np.int64):
        first = chunk * CHUNK_VOXELS
        state = voxel_box(m, first - 1, first + CHUNK_VOXELS + 1, reader).state
        unknown = state == UNKNOWN
        beside = np.zeros((CHUNK_VOXELS,) * 3, np.bool_)
        for axis in range(3):
            for step in (0, 2):
                cut = [slice(1, -1)] * 3
                cut[axis] = slice(step, step + CHUNK_VOXELS)
                beside |= unknown[tuple(cut)]
        voxels = np.argwhere(beside & (state[1:-1, 1:-1, 1:-1] == FREE))
        found.append((voxels + first).astype(np.int32))
    return np.concatenate(found)
