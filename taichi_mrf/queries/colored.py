"""The colours of a map's voxels, and what else pixels gave to them, for whoever draws or writes them.

A colour is four uint8: red, green, blue, and how much of the voxel cameras have seen, 255 for much and 0 for
nothing at all, in which case there is no colour.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.queries.known_bricks import BRICKS_AT_ONCE, BrickReader
from taichi_mrf.queries.voxel_map import PixelValues, VoxelMap
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layers import COLORS
from taichi_mrf.voxels.layout import BRICK, VOXELS

_POINTS_AT_ONCE = 1 << 19


def beside_colors(m: VoxelMap) -> dict[str, PixelValues]:
    """The layers of a map that pixels feed but for colours, by name; those with values."""
    return {name: layer for name, layer in m.pixel_layers.items() if layer and name != COLORS}


def shown_colors(m: VoxelMap, points: ArrayLike) -> NDArray[np.uint8]:
    """Colours (N, 3) of the voxels that hold the points (N, 3) in metres, as :func:`shown_colors_in` has
    them."""
    voxels = np.floor(np.asarray(points, np.float64) / m.voxel_size).astype(np.int32)
    out = np.full((len(voxels), 3), NO_COLOR, np.uint8)
    bricks, row = np.unique(voxels // BRICK, axis=0, return_inverse=True)
    slots, order = BrickReader(m).slots(bricks), np.argsort(row.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(row.reshape(-1), minlength=len(bricks)))
    local = voxels % BRICK
    numbers = (local[:, 0] * BRICK + local[:, 1]) * BRICK + local[:, 2]
    for first in range(0, len(bricks), BRICKS_AT_ONCE):
        last = min(first + BRICKS_AT_ONCE, len(bricks))
        here = order[ends[first - 1] if first else 0 : ends[last - 1]]
        found = shown_colors_in(m, slots[first:last])
        out[here] = found[row.reshape(-1)[here] - first, numbers[here]]
    return out


def shown_colors_in(m: VoxelMap, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Colours to show of the voxels of some bricks of ``view.pool``, (n,) slots -> (n, 512, 3)."""
    return painted(m.colors_in(slots))


def painted(found: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours to show of the voxels of bricks, (n, 512, 4) -> (n, 512, 3). A voxel that no coloured pixel has
    seen gets the mean of its cell of 2, 4 or 8 voxels a side, NO_COLOR where that has none either: cells
    stand in for voxels of which none is likely by itself."""
    weight = found[..., 3].astype(np.float32).reshape(-1, *(BRICK,) * 3)
    color = found[..., :3].astype(np.float32).reshape(-1, *(BRICK,) * 3, 3)
    out, missing = color.copy(), weight == 0
    for side in (2, 4, 8):
        if not missing.any():
            break
        sums, weights = (
            _cell_sums(values, side) for values in (color * weight[..., None], weight[..., None])
        )
        fill = missing & (weights[..., 0] > 0)
        out[fill] = sums[fill] / weights[fill]
        missing &= ~fill
    out[missing] = NO_COLOR
    return np.rint(out).astype(np.uint8).reshape(-1, VOXELS, 3)


def _cell_sums(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """The sum over the cell of ``side`` voxels a side that each voxel lies in, (n, 8, 8, 8, c)."""
    for axis in (1, 2, 3):
        shape = values.shape
        split = values.reshape(*shape[:axis], BRICK // side, side, *shape[axis + 1 :])
        values = np.repeat(split.sum(axis=axis + 1), side, axis=axis)
    return values


def blended_colors(m: VoxelMap, points: ArrayLike) -> NDArray[np.uint8]:
    """Colours (N, 3) at points (N, 3) in metres, blended from the voxels whose centres are the corners of the
    cube around each; a voxel counts by how near it is and by how much of it was seen. Where none of them has
    a colour it is that of :func:`shown_colors`."""
    places = np.asarray(points, np.float64)
    parts = [places[i : i + _POINTS_AT_ONCE] for i in range(0, len(places), _POINTS_AT_ONCE)]
    return np.concatenate([np.zeros((0, 3), np.uint8), *(_blended(m, part) for part in parts)])


def marginals_behind(m: VoxelMap, points: ArrayLike, normals: ArrayLike) -> NDArray[np.float32]:
    """The likeliest marginal at or half a voxel behind points (N, 3) of a surface, in metres: (N,)."""
    places = np.asarray(points, np.float64)
    behind = places - 0.5 * m.voxel_size * np.asarray(normals)
    by_marginals = m.marginals
    return np.maximum(by_marginals.occupancy(places), by_marginals.occupancy(behind))


def _blended(m: VoxelMap, points: NDArray[np.float64]) -> NDArray[np.uint8]:
    place = points / m.voxel_size - 0.5
    first = np.floor(place)
    share = place - first
    sums, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        found = m.colors((first + corner + 0.5) * m.voxel_size)
        near = np.where(np.array(corner, bool), share, 1.0 - share).prod(axis=1)
        weight = near * found[:, 3]
        sums += weight[:, None] * found[:, :3]
        weights += weight
    mean = np.rint(sums / np.maximum(weights, 1e-9)[:, None]).astype(np.uint8)
    alone = weights == 0
    mean[alone] = shown_colors(m, points[alone])
    return mean
