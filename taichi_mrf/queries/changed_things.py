"""Things that appeared or left between two maps: clusters of voxels that were free and are occupied, or the
reverse."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.change import MapChange
from taichi_mrf.queries.clear_of_surfaces import CORE_VOXELS, Surfaces, stands_clear
from taichi_mrf.queries.clusters import find_clusters
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.queries.voxel_map import VoxelMap

Verb = Literal["appeared", "left"]


@dataclass(frozen=True)
class ChangedThing:
    """Voxels that touch and changed in the same way: ``verb``, their number, and the upright box around them,
    ``lower_m`` and ``upper_m`` (3,) in metres, world."""

    verb: Verb
    voxels: int
    lower_m: NDArray[np.float64]
    upper_m: NDArray[np.float64]

    @property
    def size_m(self) -> NDArray[np.float64]:
        """Sides of the box, (3,) metres."""
        return self.upper_m - self.lower_m

    @property
    def centre_m(self) -> NDArray[np.float64]:
        """Centre of the box, (3,) metres, world."""
        return 0.5 * (self.lower_m + self.upper_m)


def without_slack(change: MapChange, a: VoxelMap, b: VoxelMap, core: int = CORE_VOXELS) -> MapChange:
    """Voxels that appeared or left from map a to map b, without what can be a surface of the other map that
    has shifted a little: clusters of which fewer than ``core`` voxels are clear of those surfaces."""
    voxels = np.floor(change.points / a.voxel_size).astype(np.int32)
    kept = np.zeros(len(voxels), np.bool_)
    for before, after, other in ((FREE, OCCUPIED, a), (OCCUPIED, FREE, b)):
        rows = np.flatnonzero((change.before == before) & (change.after == after))
        kept[rows] = stands_clear(voxels[rows], Surfaces(other.view.pool, other.voxel_size), core)
    return replace(
        change,
        points=change.points[kept],
        before=change.before[kept],
        after=change.after[kept],
        difference=change.difference[kept],
    )


def find_changed_things(
    change: MapChange, voxel_size: float, min_voxels: int = 1, reach_m: float | None = None
) -> list[ChangedThing]:
    """Things that appeared (free before, occupied after) or left (occupied before, free after), the largest
    first, without clusters of less than ``min_voxels``. Space that was unknown before is new to the map, but
    need not be new.

    ``voxel_size`` is that of the maps, in metres. Voxels belong together if they touch; with ``reach_m`` also
    those in touching cells of that size (metres), so that the seen parts of one object are one thing.
    Raises ConfigError for min_voxels below 1 or reach_m below the voxel size.
    """
    reach = 1 if reach_m is None else round(reach_m / voxel_size)
    if reach < 1:
        raise ConfigError(f"reach_m must be at least the voxel size of {voxel_size:g} m, not {reach_m:g}")
    if min_voxels < 1:
        raise ConfigError(f"min_voxels must be at least 1, not {min_voxels}")
    things = []
    verbs: tuple[tuple[Verb, NDArray[np.float64]], ...]
    verbs = ("appeared", change.appeared), ("left", change.vanished)
    for verb, points in verbs:
        voxels = np.floor(points / voxel_size).astype(np.int32)
        cells, cell = np.unique(voxels // reach, axis=0, return_inverse=True)
        of_cells, _ = find_clusters(cells)
        cluster = of_cells[cell.reshape(-1)]
        for number in np.flatnonzero(np.bincount(cluster) >= min_voxels):
            mine = voxels[cluster == number]
            box = mine.min(axis=0) * voxel_size, (mine.max(axis=0) + 1) * voxel_size
            things.append(ChangedThing(verb, len(mine), *box))
    return sorted(things, key=lambda thing: -thing.voxels)
