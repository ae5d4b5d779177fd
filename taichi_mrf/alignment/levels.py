"""From coarse to fine: an alignment's levels, few points and wide cells first, all points and the map's own
voxels last."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.keyframe_pictures import ColorLevel
from taichi_mrf.alignment.levenberg import OBSERVABLE, Aligned, align
from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.point_to_plane import PointToPlane
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.geometry.poses import Pose

COARSEST_M = 0.08
"""Least width of the first level's cells, in metres. Surfaces further away than 1.5 cells are not found."""

THINNED = (4, 2, 1)
"""Steps between the points that each level takes along rows and columns: strides of 8, 4 and 2 pixels."""

LEAST_POINTS = 50
"""Points that an alignment needs, however small the image."""


def margin_m(cell_size: float) -> float:
    """Metres beyond the points up to which the surface is used."""
    return 2 * max(cell_size, COARSEST_M)


def bounds(
    points: OrientedPoints, poses: Sequence[Pose], margin: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The corners of a box, in metres in the world, around the points as seen from each of some poses."""
    world = np.concatenate([points.points @ T[:3, :3].T + T[:3, 3] for T in poses])
    return world.min(axis=0) - margin, world.max(axis=0) + margin


def grids_of(surface: Surfels, coarsest_m: float = COARSEST_M, finest_m: float = 0.0) -> list[SurfelGrid]:
    """The surface at each level, in cells from at least ``coarsest_m`` metres to the surface's own, or the
    multiple of those that is nearest to ``finest_m``."""
    surface = surface.coarser(max(1, round(finest_m / surface.cell_size)))
    doublings = max(0, int(np.ceil(np.log2(coarsest_m / surface.cell_size))))
    factors = (2**doublings, 2 ** (doublings // 2), 1)
    return [SurfelGrid(surface.coarser(factor)) for factor in factors]


def levels_of(points: OrientedPoints, grids: Sequence[SurfelGrid]) -> list[PointToPlane]:
    """The residuals of each level."""
    return [PointToPlane(points.thinned(n), grid) for n, grid in zip(THINNED, grids, strict=True)]


def aligned(
    levels: Sequence[PointToPlane],
    T_world_camera: Pose,
    recorded: Recorded,
    lever_m: float,
    observable: float = OBSERVABLE,
) -> Aligned:
    """The pose at which a search from ``T_world_camera`` ends; see levenberg.align."""
    found = align(levels[0], T_world_camera, recorded, lever_m, observable)
    for level in levels[1:]:
        found = align(level, found.T_world_camera, recorded, lever_m, observable)
    return found


def aligned_with_color(
    levels: Sequence[PointToPlane],
    colors: Sequence[ColorLevel],
    T_world_camera: Pose,
    recorded: Recorded,
    lever_m: float,
    observable: float,
) -> Aligned:
    """Pose at the end of a search that also uses colour, coarse and fine, on the finer levels."""
    found = Aligned(T_world_camera, levels[-1].linearised(T_world_camera), 0)
    for level, color in zip(levels[1:], colors, strict=True):
        T = found.T_world_camera
        found = align(level, T, recorded, lever_m, observable, color.seen_from(T))
    return found
