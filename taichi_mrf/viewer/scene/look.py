"""From view options to what a chunk looks like, and which way is up."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.viewer.live.options import ViewOptions
from taichi_mrf.viewer.scene.coloring import scale_of
from taichi_mrf.viewer.scene.cut_plane import cut_voxel
from taichi_mrf.viewer.scene.voxel_layer import Look
from taichi_mrf.viewer.scene.voxel_store import VoxelStore
from taichi_mrf.voxels.layout import BRICK

Up = tuple[int, int]
"""An axis of the world, and 1 or -1 for its direction."""


def up_of(T_world_camera: Pose) -> Up:
    """The axis of the world nearest to a camera's upward direction (its image's -y)."""
    upwards = -T_world_camera[:3, 1]
    axis = int(np.argmax(np.abs(upwards)))
    return axis, 1 if upwards[axis] > 0 else -1


def up_vector(up: Up) -> NDArray[np.float64]:
    """The unit vector that points up."""
    return up[1] * np.eye(3)[up[0]]


def look_of(options: ViewOptions, store: VoxelStore, up: Up, voxel_size: float) -> Look:
    """What the voxels of a map shall look like."""
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
        up=up,
    )


def _heights_m(store: VoxelStore, up: Up, voxel_size: float) -> tuple[float, float]:
    """Heights of the lowest and the highest brick's far sides."""
    bounds = store.bounds()
    if bounds is None:
        return 0.0, 1.0
    axis, sign = up
    ends = sign * BRICK * voxel_size * np.array([bounds[0][axis], bounds[1][axis] + 1])
    return float(ends.min()), float(ends.max())
