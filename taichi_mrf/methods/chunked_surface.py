"""The surface of a map in chunks, made from the signed distances in its store, some chunks at a time."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.export.fused_surface import FusedSurface, fused_surface, within_voxels, without_free
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.mrf.surfacing import LEAST
from taichi_mrf.queries.colored import ColoredMap, blended_colors
from taichi_mrf.voxels.layout import BRICK

MARGIN = BRICK
"""Voxels around a box from which its surface is made too, before it is cut: more than any vertex's position,
normal and standard deviation depend on."""


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
    distances = source.distances(first - MARGIN, after + MARGIN)
    found = without_free(source, fused_surface(distances, source.voxel_size), LEAST * source.prior)
    found = within_voxels(found, source.voxel_size, first, after)
    return found if colored is None else replace(found, colors=blended_colors(colored, found.vertices_m))
