"""The outlines of the map's bricks, as lines."""

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.voxels.layout import BRICK

_COLOR = (120, 120, 120)
_NODE = "/bricks"


def brick_edges(bricks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges (n, 2, 3) of the bricks (m, 3), as lattice points; an edge that several bricks share is listed
    once."""
    edges = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for a in (0, 1):
            for b in (0, 1):
                start = bricks.copy()
                start[:, others[0]] += a
                start[:, others[1]] += b
                edges.append(np.column_stack([start, np.full(len(bricks), axis)]))
    unique = np.unique(np.concatenate(edges), axis=0)
    start, axes = unique[:, :3], unique[:, 3]
    return np.stack([start, start + np.eye(3, dtype=np.int64)[axes]], axis=1)


class BrickLines:
    """Owns the lines in the scene."""

    def __init__(self, scene: viser.SceneApi, voxel_size: float) -> None:
        self._scene, self._voxel_size = scene, voxel_size
        self._node: viser.LineSegmentsHandle | None = None

    def show(self, bricks: NDArray[np.int64] | None) -> None:
        """Draw the outlines of bricks (n, 3); no bricks, or None, remove them."""
        if bricks is None or not len(bricks):
            self.hide()
            return
        lines = (brick_edges(bricks) * BRICK * self._voxel_size).astype(np.float32)
        self._node = self._scene.add_line_segments(
            _NODE, lines, _COLOR, thickness=1.0, thickness_units="screen"
        )

    def hide(self) -> None:
        """Remove the lines from the scene."""
        if self._node is not None:
            self._node.remove()
            self._node = None
