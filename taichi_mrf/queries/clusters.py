"""Clusters of voxels: those that touch, be it at a corner, belong together."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.system.libraries import library
from taichi_mrf.voxels.layout import grid_keys

_HALF_OF_NEIGHBOURS = np.stack(np.unravel_index(np.arange(14, 27), (3, 3, 3)), axis=1) - 1
"""13 of the 26 neighbours of a voxel; the others are these seen from the other side."""


def find_clusters(
    voxels: NDArray[np.int32], min_voxels: int, purpose: str
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The cluster of each voxel, coordinates (N, 3) -> (N,) int32, and the sizes (K,) of the clusters, the
    largest first; -1 for voxels in clusters of less than ``min_voxels``.

    ``purpose`` says in the error what needs SciPy. Raises ConfigError for min_voxels below 1, TaichiMRFError
    without SciPy.
    """
    if min_voxels < 1:
        raise ConfigError(f"min_voxels must be at least 1, not {min_voxels}")
    graphs = library("scipy.sparse", purpose, "mesh")
    csgraph = library("scipy.sparse.csgraph", purpose, "mesh")
    pairs = _touching(voxels)
    graph = graphs.coo_matrix((np.ones(len(pairs), np.int8), pairs.T), (len(voxels), len(voxels)))
    labels = csgraph.connected_components(graph, directed=False)[1] if len(voxels) else np.zeros(0, np.int32)
    counts = np.bincount(labels)
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= min_voxels]
    number = np.full(len(counts), -1, np.int32)
    number[order] = np.arange(len(order))
    return number[labels], counts[order]


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
