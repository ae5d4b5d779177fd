"""The cut: a layer of voxels as a picture that stands in the cut's plane.

Free voxels are blue, occupied ones yellow; unknown voxels are transparent, so that free and unknown space
look different.
"""

from collections.abc import Iterable

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import LOG_ODDS_STEP
from taichi_mrf.viewer.scene.voxel_store import Cut, VoxelStore
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS

FREE = (70, 130, 200, 110)
OCCUPIED = (253, 200, 36, 230)
UNKNOWN = (0, 0, 0, 0)

_MOST_PIXELS = 2048
_NODE = "/cut"

# Local x, y and z of the picture (columns to the right, rows downwards, away from the reader) as the
# world's axes, for a cut across x, y, z; each is a rotation by a third of a turn or none.
_WXYZ = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))
_AXES = ((1, 2), (2, 0), (0, 1))


def cut_voxel(store: VoxelStore, axis: int, share: float) -> Cut | None:
    """The cut at a position between one end of the map (0) and the other (1) along ``axis``; None for an
    empty map."""
    bounds = store.bounds()
    if bounds is None:
        return None
    low, high = int(bounds[0][axis]) * BRICK, int(bounds[1][axis] + 1) * BRICK - 1
    return Cut(axis, low + round(share * (high - low)))


def cut_picture(
    store: VoxelStore,
    cut: Cut,
    prior_log_odds: float,
    min_evidence: float,
    crossed: Iterable[NDArray[np.int32]],
) -> NDArray[np.uint8]:
    """The layer of voxels at the cut, (rows, columns, 4) RGBA, one pixel a voxel.

    Columns follow the first and rows the second of the axes after the cut's; the picture covers
    :meth:`VoxelStore.bounds`. ``crossed`` are bricks (n, 3) that rays cross; they are free unless the store
    holds them. Free, occupied and unknown are defined as in queries.points.classify.
    """
    columns, rows = _AXES[cut.axis]
    bounds = store.bounds()
    assert bounds is not None
    low, high = bounds
    size = (high - low + 1) * BRICK
    picture = np.zeros((size[rows], size[columns], 4), np.uint8)
    here = [bricks[bricks[:, cut.axis] == cut.voxel // BRICK][:, [rows, columns]] for bricks in crossed]
    seen = np.zeros((size[rows] // BRICK, size[columns] // BRICK), bool)
    for bricks in here:
        at = bricks - low[[rows, columns]]
        at = at[((at >= 0) & (at < seen.shape)).all(axis=1)]
        seen[at[:, 0], at[:, 1]] = True
    picture[np.kron(seen, np.ones((BRICK, BRICK), bool))] = FREE
    for key, chunk in store.chunks.items():
        if key[cut.axis] != cut.voxel // CHUNK_VOXELS:
            continue
        cells, packed = chunk.slab(cut.axis, cut.voxel % CHUNK_VOXELS)
        if columns > rows:  # a slab lists the axes that are left in their own order
            cells = cells[:, ::-1]
        at = cells[:, ::-1] + (np.array(key)[[rows, columns]] * CHUNK - low[[rows, columns]]) * BRICK
        picture[at[:, 0], at[:, 1]] = _classes(packed * LOG_ODDS_STEP, prior_log_odds, min_evidence)
    return picture


class CutPlane:
    """Owns the picture in the scene."""

    def __init__(self, scene: viser.SceneApi, voxel_size: float) -> None:
        self._scene, self._voxel_size = scene, voxel_size
        self._node: viser.ImageHandle | None = None

    def show(self, store: VoxelStore, cut: Cut, picture: NDArray[np.uint8]) -> None:
        """Show a :func:`cut_picture` in the plane of the cut."""
        bounds = store.bounds()
        assert bounds is not None
        low_m = bounds[0] * BRICK * self._voxel_size
        high_m = (bounds[1] + 1) * BRICK * self._voxel_size
        centre = (low_m + high_m) / 2
        centre[cut.axis] = (cut.voxel + 1) * self._voxel_size
        columns, rows = _AXES[cut.axis]
        shrink = -(-max(picture.shape[:2]) // _MOST_PIXELS)
        if shrink == 1:  # so that the edges of voxels stay sharp when seen from near
            grow = max(1, _MOST_PIXELS // (4 * max(picture.shape[:2])))
            picture = cv2.resize(picture, None, fx=grow, fy=grow, interpolation=cv2.INTER_NEAREST)
        else:
            picture = np.ascontiguousarray(picture[::shrink, ::shrink])
        self._node = self._scene.add_image(
            _NODE,
            picture,
            float((high_m - low_m)[columns]),
            float((high_m - low_m)[rows]),
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            wxyz=_WXYZ[cut.axis],
            position=centre,
        )

    def hide(self) -> None:
        """Remove the picture from the scene."""
        if self._node is not None:
            self._node.remove()
            self._node = None


def _classes(log_odds: NDArray[np.floating], prior_log_odds: float, min_evidence: float) -> NDArray[np.uint8]:
    """Colours (n, 4) of log-odds (n,)."""
    colors = np.zeros((len(log_odds), 4), np.uint8)
    colors[log_odds < prior_log_odds - min_evidence] = FREE
    colors[(log_odds > 0) & (np.abs(log_odds - prior_log_odds) > min_evidence)] = OCCUPIED
    return colors
