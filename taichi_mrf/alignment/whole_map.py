"""A map in which a recording of another day is searched for: its surface, walls, free space and cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.levels import grids_of
from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.surfels import Planes, Surfels, surfels_of
from taichi_mrf.geometry.up import up_vector
from taichi_mrf.queries.box import map_extent
from taichi_mrf.queries.points import FREE
from taichi_mrf.queries.voxel_map import VoxelMap


@dataclass(frozen=True)
class WholeMap:
    """A map's view of its world: its ``surface``; the ``walls``, measured by several of its keyframes, which
    no ray can pass; the positions ``cameras_m`` (N, 3) of its keyframes; and ``up`` (3,), the upward
    direction, to within 45 degrees. ``is_free`` says which points (N, 3), in metres, lie in free space,
    (N,), and ``colors`` gives their colours (N, 4) with weights. ``most_through`` is the share of the walls
    that a camera's images may look through."""

    surface: Surfels
    walls: Planes
    cameras_m: NDArray[np.float64]
    up: NDArray[np.float64]
    is_free: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
    colors: Callable[[NDArray[np.float64]], NDArray[np.uint8]] | None = None
    most_through: float = RULES.whole_through

    @cached_property
    def planes(self) -> Planes:
        """The surface where a wide search looks for it."""
        return self.surface.coarser(max(1, round(RULES.around_finest_m / self.surface.cell_size))).planes()

    @cached_property
    def levels(self) -> list[tuple[SurfelGrid, int, int | None]]:
        """From coarse to fine, the surface, of how many of a scan's points one is aligned with it, and how
        many of the best poses are, all if None."""
        coarse = grids_of(self.surface, RULES.around_first_m, RULES.around_finest_m)
        fine = grids_of(self.surface, RULES.around_finest_m, RULES.whole_finest_m)[1:]
        thinned = zip(coarse, (8, 2, 1), strict=True)
        return [(grid, every, None) for grid, every in thinned] + [
            (grid, 1, RULES.whole_places) for grid in fine
        ]

    def may_look_through(self, around: bool) -> float:
        """The share of the walls that a sensor may look through, which sees ``around`` or not."""
        return RULES.whole_scan_through if around else self.most_through

    def in_free(self, points_m: NDArray[np.float64]) -> float:
        """The share of points (N, 3) around which all is free."""
        reach_m = max(RULES.whole_free_m, 2 * self.surface.cell_size)
        free = self.is_free(points_m)
        for step in reach_m * np.concatenate([np.eye(3), -np.eye(3)]):
            free[free] = self.is_free(points_m[free] + step)
        return float(free.mean())


def map_of_voxels(m: VoxelMap) -> WholeMap:
    """The view from the voxels alone, for a map whose keyframe images are gone. The surface is the occupied
    voxels beside free space: all are walls, and their normals point into that space. Any free place is a
    camera position."""
    marginals, voxel_m, up = m.marginals, m.voxel_size, m.up
    assert up is not None

    def is_free(points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        return marginals.state(points_m) == FREE

    centres_m, _ = m.voxels()
    open_to = np.zeros(centres_m.shape)
    for step in np.argwhere(np.ones((5, 5, 5))) - 2:
        if 0 < step @ step <= 5:
            open_to[is_free(centres_m + voxel_m * step)] += step / np.linalg.norm(step)
    lengths = np.linalg.norm(open_to, axis=1)
    beside = lengths > 1
    points = OrientedPoints(
        centres_m[beside].astype(np.float32),
        (open_to[beside] / lengths[beside, None]).astype(np.float32),
        np.full(beside.sum(), voxel_m / 4, np.float32),
        np.zeros((beside.sum(), 2), np.int32),
    )
    surface = surfels_of(points, np.eye(4), 2 * voxel_m)
    lower_m, upper_m = map_extent(m)
    number = np.ceil((upper_m - lower_m) / RULES.grid_widest_m).astype(int)
    places_m = lower_m + RULES.grid_widest_m * np.argwhere(np.ones(number))
    walls = walls_of(surface, [surface, surface])
    return WholeMap(
        surface, walls, places_m[is_free(places_m)], up_vector(up), is_free,
        m.colors if m.has_colors else None, RULES.whole_voxels_through,
    )  # fmt: skip


def walls_of(surface: Surfels, parts: Sequence[Surfels]) -> Planes:
    """The opaque part of a map's surface: cells that more than one of its ``parts``, one per keyframe, has
    measured. At most RULES.whole_walls of them, evenly chosen."""
    keys, number = np.unique(np.concatenate([part.keys for part in parts]), return_counts=True)
    rows = np.flatnonzero(np.isin(surface.keys, keys[number > 1]))
    some = np.linspace(0, len(rows) - 1, min(len(rows), RULES.whole_walls)).astype(np.int64)
    return surface.chosen(rows[some]).planes()
