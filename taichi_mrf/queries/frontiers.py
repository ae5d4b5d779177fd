"""Clusters of voxels that touch, and frontiers: free voxels beside unknown ones, where exploration goes on
(Yamauchi 1997).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import voxel_box
from taichi_mrf.queries.known_bricks import BrickReader, known_bricks, sorted_bricks
from taichi_mrf.queries.points import FREE, UNKNOWN
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels.layout import CHUNK, CHUNK_VOXELS, grid_keys

_HALF_OF_NEIGHBOURS = np.stack(np.unravel_index(np.arange(14, 27), (3, 3, 3)), axis=1) - 1
"""13 of the 26 neighbours of a voxel; the others are these seen from the other side."""


def find_clusters(
    voxels: NDArray[np.int32], min_voxels: int = 1
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The cluster of each voxel, coordinates (N, 3) -> (N,) int32, and the sizes (K,) of the clusters, the
    largest first; -1 for voxels in clusters of less than ``min_voxels``. Raises ConfigError for min_voxels
    below 1."""
    if min_voxels < 1:
        raise ConfigError(f"min_voxels must be at least 1, not {min_voxels}")
    firsts, labels = np.unique(_first_of_each(_touching(voxels), len(voxels)), return_inverse=True)
    counts = np.bincount(labels, minlength=len(firsts))
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= min_voxels]
    number = np.full(len(counts), -1, np.int32)
    number[order] = np.arange(len(order))
    return number[labels], counts[order]


def _first_of_each(pairs: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """The first row of each row's group, (count,), if the rows of each of the pairs (p, 2) are in one."""
    first = np.arange(count)
    while len(pairs):
        a, b = first[pairs].T
        apart = a != b
        pairs, a, b = pairs[apart], a[apart], b[apart]
        np.minimum.at(first, np.maximum(a, b), np.minimum(a, b))
        further = first[first]
        while (further != first).any():
            first, further = further, further[further]
    return first


def _touching(voxels: NDArray[np.int32]) -> NDArray[np.int64]:
    """Pairs (p, 2) of rows whose voxels touch."""
    keys = grid_keys(voxels)
    order = np.argsort(keys)
    ascending = keys[order]
    pairs = [np.zeros((0, 2), np.int64)]
    for step in _HALF_OF_NEIGHBOURS:
        wanted = grid_keys(voxels + step.astype(np.int32))
        places = np.minimum(np.searchsorted(ascending, wanted), max(len(keys) - 1, 0))
        there = np.flatnonzero(ascending[places] == wanted) if len(keys) else np.zeros(0, np.int64)
        pairs.append(np.stack([there, order[places[there]]], axis=1))
    return np.concatenate(pairs)


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
    """All free voxels that share a face with an unknown one. Those that touch, even at a corner, form one
    cluster; clusters of fewer than ``min_voxels`` are left out. A well-observed voxel that is unknown only
    because some rays end in it (inference/thin_matter.py) makes no frontier.

    The map is read chunk by chunk, so that memory is bounded by the result. Raises ConfigError for min_voxels
    below 1.
    """
    voxels = frontier_voxels(m)
    cluster, sizes = find_clusters(voxels, min_voxels)
    kept = cluster >= 0
    points, cluster = (voxels[kept].astype(np.float64) + 0.5) * m.voxel_size, cluster[kept]
    sums = [np.bincount(cluster, points[:, axis], len(sizes)) for axis in range(3)]
    return Frontiers(points, cluster, sizes, np.stack(sums, axis=1) / np.maximum(sizes, 1)[:, None])


def frontier_voxels(m: VoxelMap) -> NDArray[np.int32]:
    """Coordinates (n, 3) of the free voxels that share a face with an unknown one, ascending by chunk."""
    decided, by_marginals = BrickReader(m.decided), BrickReader(m)
    found = [np.zeros((0, 3), np.int32)]
    for chunk in sorted_bricks(known_bricks(m.decided) // CHUNK).astype(np.int64):
        first = chunk * CHUNK_VOXELS
        around = first - 1, first + CHUNK_VOXELS + 1
        state = voxel_box(m.decided, *around, decided).state
        unknown = (state == UNKNOWN) & (voxel_box(m, *around, by_marginals).state == UNKNOWN)
        beside = np.zeros((CHUNK_VOXELS,) * 3, np.bool_)
        for axis in range(3):
            for step in (0, 2):
                cut = [slice(1, -1)] * 3
                cut[axis] = slice(step, step + CHUNK_VOXELS)
                beside |= unknown[tuple(cut)]
        voxels = np.argwhere(beside & (state[1:-1, 1:-1, 1:-1] == FREE))
        found.append((voxels + first).astype(np.int32))
    return np.concatenate(found)
