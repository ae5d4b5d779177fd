"""A band of heights as a 2D map: what a robot that drives on the floor would bump into."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import map_extent
from taichi_mrf.queries.known_bricks import BrickReader, QueriedMap, known_bricks
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN, probability
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick


@dataclass(frozen=True)
class LevelMap:
    """Cells as wide as voxels. ``state`` (rows, columns) int8 is UNKNOWN, FREE or OCCUPIED, ``highest``
    (rows, columns) float32 the largest probability among the known voxels of the band, 0 without one; rows
    run from the lowest y up. ``lower_x_y`` is the outer corner of the first cell, in metres."""

    state: NDArray[np.int8]
    highest: NDArray[np.float32]
    lower_x_y: tuple[float, float]
    cell_size: float


def level_map(
    m: QueriedMap,
    z_min: float | None,
    z_max: float | None,
    occupied_from: float = 0.5,
    free_below: float = 0.5,
) -> LevelMap:
    """Look at the voxels whose centres lie between two heights, in metres, z up.

    A cell is OCCUPIED if one of them has a probability of at least ``occupied_from``, FREE if those that are
    known all have less than ``free_below``, else UNKNOWN. Raises ConfigError for an empty map and, with the
    map's own heights, if one of the two is missing or no voxel lies between them.
    """
    lower_m, upper_m = map_extent(m)
    if z_min is None or z_max is None:
        raise ConfigError(f"a 2D map needs a band of heights, z_min and z_max; {_heights(m)}")
    first = np.rint(lower_m[:2] / m.voxel_size).astype(np.int64)
    columns, rows = np.rint(upper_m[:2] / m.voxel_size).astype(np.int64) - first
    highest = np.full((rows, columns), -1.0, np.float32)
    bricks = known_bricks(m)
    low, high = bricks[:, 2] * BRICK * m.voxel_size, (bricks[:, 2] + 1) * BRICK * m.voxel_size
    bricks = bricks[(high > z_min) & (low < z_max)]
    inside = offsets_in_brick()
    for piece, log_odds, state in BrickReader(m).batches(bricks):
        z = (piece[:, 2, None] * BRICK + inside[:, 2] + 0.5) * m.voxel_size
        row, number = np.nonzero((state != UNKNOWN) & (z >= z_min) & (z <= z_max))
        x, y = (piece[row, :2] * BRICK + inside[number, :2] - first).T
        np.maximum.at(highest, (y, x), probability(log_odds[row, number]))
    seen = highest >= 0
    if not seen.any():
        raise ConfigError(f"nothing is known between z_min {z_min:g} m and z_max {z_max:g} m; {_heights(m)}")
    state = np.full(highest.shape, UNKNOWN, np.int8)
    state[seen & (highest < free_below)] = FREE
    state[seen & (highest >= occupied_from)] = OCCUPIED
    corner = first * m.voxel_size
    return LevelMap(state, np.maximum(highest, 0), (float(corner[0]), float(corner[1])), m.voxel_size)


def _heights(m: QueriedMap) -> str:
    """Between which heights something is known, in words."""
    layers = set()
    for piece, _, state in BrickReader(m).batches(known_bricks(m)):
        row, number = np.nonzero(state != UNKNOWN)
        layers.update(np.unique(piece[row, 2] * BRICK + offsets_in_brick()[number, 2]).tolist())
    if not layers:
        return "nothing is known at any height"
    low, high = min(layers) * m.voxel_size, (max(layers) + 1) * m.voxel_size
    return f"the map is known from {low:.2f} m to {high:.2f} m"
