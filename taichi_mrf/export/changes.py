"""Changes between two maps as a PLY of points: voxels that have appeared or vanished."""

from pathlib import Path

import numpy as np

from taichi_mrf.export.ply import NO_ORIGIN, write_points
from taichi_mrf.queries.change import STATES, MapChange
from taichi_mrf.queries.points import OCCUPIED

APPEARED, VANISHED = (213, 94, 0), (0, 114, 178)
"""RGB of voxels that are occupied only in the second map, and only in the first."""


def write_changes(
    path: str | Path,
    change: MapChange,
    voxel_size: float,
    origin_m: tuple[float, float, float] = NO_ORIGIN,
) -> int:
    """Write the voxels that are occupied in one of the maps only; returns how many. Their origin is
    ``origin_m`` in the recorded world. Raises MapFileError.

    Besides its position and colour a point has the properties ``before`` and ``after``, its states, and
    ``difference``, by how much its probability has grown.
    """
    shown = (change.before == OCCUPIED) | (change.after == OCCUPIED)
    appeared = change.after[shown] == OCCUPIED
    colors = np.where(appeared[:, None], APPEARED, VANISHED).astype(np.uint8)
    extra = {
        "before": change.before[shown].astype(np.uint8),
        "after": change.after[shown].astype(np.uint8),
        "difference": change.difference[shown].astype("<f4"),
    }
    states = ", ".join(f"{number} {name}" for number, name in enumerate(STATES))
    comments = [
        f"voxel_size {voxel_size:.9g} metres",
        f"before and after are states: {states}",
        f"color is {APPEARED} where a surface has appeared, {VANISHED} where one has vanished",
    ]
    write_points(path, change.points[shown], colors, extra, comments, origin_m)
    return int(shown.sum())
