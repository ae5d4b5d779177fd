"""2D maps in the format of ROS's map_server: a grey image and a YAML file with its position; and a
band of heights of a map as cells for them: the obstacles that a robot on the floor would hit."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.up import Z_UP, Up, plan_axes, up_name
from taichi_mrf.queries.box import map_extent
from taichi_mrf.queries.known_bricks import BrickReader, known_bricks
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN, probability
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.atomic import atomic_path, write_text
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick

OCCUPIED_GREY, FREE_GREY, UNKNOWN_GREY = 0, 254, 205
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""map_server's thresholds: a cell is occupied from the first probability on, free up to the second; the three
grey values stand for 1, 0.004 and 0.196, the last of which it reads as unknown."""


def grey_image(occupied: NDArray[np.bool_], seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Cells (rows, columns), rows from the lowest y up, as an image whose top row has the highest y."""
    grey = np.where(occupied, OCCUPIED_GREY, FREE_GREY)
    return np.flipud(np.where(seen, grey, UNKNOWN_GREY)).astype(np.uint8)


def write_map_server(
    folder: Path,
    image: NDArray[np.uint8],
    cell_size: float,
    lower_corner_m: tuple[float, float],
    name: str = "map",
    note: str | None = None,
) -> list[Path]:
    """Write ``map.pgm`` and ``map.yaml``, or of another name; returns their paths. Raises MapFileError.

    ``lower_corner_m`` is the outer corner of the image's lower left pixel, in metres, as is ``cell_size``.
    ``note`` becomes a comment in the YAML file.
    """
    pgm, description = folder / f"{name}.pgm", folder / f"{name}.yaml"
    height, width = image.shape
    with atomic_path(pgm) as temporary:
        temporary.write_bytes(f"P5\n{width} {height}\n255\n".encode("ascii") + image.tobytes())
    values = {
        "image": pgm.name,
        "resolution": float(cell_size),
        "origin": [float(lower_corner_m[0]), float(lower_corner_m[1]), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }
    comment = "" if note is None else f"# {note}\n"
    write_text(description, comment + yaml.safe_dump(values, sort_keys=False, default_flow_style=None))
    return [pgm, description]


@dataclass(frozen=True)
class LevelMap:
    """Cells as wide as voxels, seen from above.

    ``state`` (rows, columns) int8 is UNKNOWN, FREE or OCCUPIED; ``highest`` (rows, columns) float32 is the
    largest probability among the known voxels of the band, 0 without one. Columns run along the world's axis
    ``axes[0]``, rows along ``axes[1]``, both ascending; ``lower_corner_m`` is the outer corner of the first
    cell in metres along these two axes.
    """

    state: NDArray[np.int8]
    highest: NDArray[np.float32]
    lower_corner_m: tuple[float, float]
    cell_size: float
    axes: tuple[int, int]


def level_map(
    m: VoxelMap,
    z_min: float | None,
    z_max: float | None,
    occupied_from: float = 0.5,
    free_below: float = 0.5,
    up: Up = Z_UP,
) -> LevelMap:
    """Project the voxels whose centres lie between two heights, in metres along ``up``, onto the floor.

    A cell is OCCUPIED if one of them has a probability of at least ``occupied_from``, FREE if those that are
    known all have less than ``free_below``, else UNKNOWN. Raises ConfigError for an empty map and, with the
    map's own heights, if one of the two is missing or no voxel lies between them.
    """
    (axis, sign), axes = up, plan_axes(up)
    lower_m, upper_m = map_extent(m)
    if z_min is None or z_max is None:
        raise ConfigError(f"a 2D map needs a band of heights, z_min and z_max; {_heights(m, up)}")
    low_m, high_m = sorted((sign * z_min, sign * z_max))
    first = np.rint(lower_m[list(axes)] / m.voxel_size).astype(np.int64)
    columns, rows = np.rint(upper_m[list(axes)] / m.voxel_size).astype(np.int64) - first
    highest = np.full((rows, columns), -1.0, np.float32)
    bricks = known_bricks(m)
    begin, end = bricks[:, axis] * BRICK * m.voxel_size, (bricks[:, axis] + 1) * BRICK * m.voxel_size
    bricks = bricks[(end > low_m) & (begin < high_m)]
    inside = offsets_in_brick()
    for piece, log_odds, state in BrickReader(m).batches(bricks):
        along_m = (piece[:, axis, None] * BRICK + inside[:, axis] + 0.5) * m.voxel_size
        row, number = np.nonzero((state != UNKNOWN) & (along_m >= low_m) & (along_m <= high_m))
        column_at, row_at = (piece[row][:, axes] * BRICK + inside[number][:, axes] - first).T
        np.maximum.at(highest, (row_at, column_at), probability(log_odds[row, number]))
    seen = highest >= 0
    if not seen.any():
        raise ConfigError(
            f"nothing is known between z_min {z_min:g} m and z_max {z_max:g} m; {_heights(m, up)}"
        )
    state = np.full(highest.shape, UNKNOWN, np.int8)
    state[seen & (highest < free_below)] = FREE
    state[seen & (highest >= occupied_from)] = OCCUPIED
    corner = first * m.voxel_size
    return LevelMap(state, np.maximum(highest, 0), (float(corner[0]), float(corner[1])), m.voxel_size, axes)


def _heights(m: VoxelMap, up: Up) -> str:
    """Between which heights something is known, in words."""
    axis, sign = up
    layers = set()
    for piece, _, state in BrickReader(m).batches(known_bricks(m)):
        row, number = np.nonzero(state != UNKNOWN)
        layers.update(np.unique(piece[row, axis] * BRICK + offsets_in_brick()[number, axis]).tolist())
    if not layers:
        return "nothing is known at any height"
    low, high = sorted(sign * layer * m.voxel_size for layer in (min(layers), max(layers) + 1))
    return f"the map is known from {low:.2f} m to {high:.2f} m (up is {up_name(up)})"
