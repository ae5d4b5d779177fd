"""Clusters of voxels: those that touch, be it at a corner, belong together."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.voxels.layout import grid_keys

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
