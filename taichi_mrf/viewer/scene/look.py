"""From view options to what a chunk looks like."""

import numpy as np

from taichi_mrf.geometry.up import Up
from taichi_mrf.viewer.scene.coloring import scale_of
from taichi_mrf.viewer.scene.cut_plane import cut_voxel
from taichi_mrf.viewer.scene.options import ViewOptions
from taichi_mrf.viewer.scene.voxel_layer import Look
from taichi_mrf.viewer.scene.voxel_store import VoxelStore
from taichi_mrf.voxels.layout import BRICK


def look_of(options: ViewOptions, store: VoxelStore, up: Up, voxel_size: float) -> Look:
    """How the voxels of a map look."""
    cut = None
    if options.cut_axis != "none":
        cut = cut_voxel(store, "xyz".index(options.cut_axis), options.cut_at)
    return Look(
        log_odds=float(np.log(options.threshold / (1 - options.threshold))),
        cut=cut,
        scale=scale_of(
            options.color_by,
            options.threshold,
            _heights_m(store, up, voxel_size),
            store.most_seen() if options.color_by == "keyframes" else 1,
        ),
        point_size=options.size,
        shade=options.shade,
        dynamic=options.dynamic,
        up=up,
    )


def _heights_m(store: VoxelStore, up: Up, voxel_size: float) -> tuple[float, float]:
    """Heights of the lower side of the lowest brick and of the upper side of the highest, in metres."""
    bounds = store.bounds()
    if bounds is None:
        return 0.0, 1.0
    axis, sign = up
    ends = sign * BRICK * voxel_size * np.array([bounds[0][axis], bounds[1][axis] + 1])
    return float(ends.min()), float(ends.max())
