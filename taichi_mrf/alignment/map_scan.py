"""A map of which only voxels are left, as scans that are searched for in another map.

Depth images rendered of it would have steps where voxels have faces, and few of them fit anywhere. Its
surface, with the direction of free space for normals (whole_map.map_of_voxels), fits as it is.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.alignment.whole_map import Scan, WholeMap
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.queries.points import UNKNOWN
from taichi_mrf.queries.voxel_map import VoxelMap

REACH = 60
"""Voxels from a place up to which the surface is part of its scan: at least RULES.whole_aside_m."""


class MapScan(Scan):
    """The surface of the map ``m``, as ``seen``, up to ``reach_m`` metres from a place (3,) in it."""

    def __init__(self, m: VoxelMap, seen: WholeMap, place_m: NDArray[np.float64], reach_m: float) -> None:
        self._marginals, self._seen = m.marginals, seen
        T, surface = np.eye(4), seen.surface.planes()
        T[:3, 3] = place_m
        near = np.linalg.norm(surface.points_m - place_m, axis=1) < reach_m
        points = OrientedPoints(
            (surface.points_m[near] - place_m).astype(np.float32),
            surface.normals[near].astype(np.float32),
            np.full(near.sum(), m.voxel_size / 4, np.float32),
            np.zeros((near.sum(), 2), np.int32),
        )
        colors = None if seen.colors is None else seen.colors(surface.points_m[near])
        known = None if colors is None else np.where(colors[:, 3:] > 0, colors[:, :3], 0)
        super().__init__(T, points, seen.up, known)

    def looks_through(self, surface: Planes, T_map_scan: Pose) -> float:
        """The share that lies where this map is free, of all that lies where it is known."""
        T = self.T_recording_scan @ inverse(T_map_scan)
        points_m = surface.points_m @ T[:3, :3].T + T[:3, 3]
        points_m = points_m[self._marginals.state(points_m) != UNKNOWN]
        return self._seen.in_free(points_m) if len(points_m) else 0.0


def scans_of(m: VoxelMap, seen: WholeMap) -> Iterator[MapScan]:
    """Scans at free places of a map, as ``seen``, which are apart: those with the most surface near first."""
    reach_m = max(RULES.whole_aside_m, REACH * m.voxel_size)
    around = cKDTree(seen.surface.planes().points_m)
    number = around.query_ball_point(seen.cameras_m, reach_m, return_length=True)
    taken: list[NDArray[np.float64]] = []
    for place_m in seen.cameras_m[np.argsort(-number, kind="stable")]:
        if all(np.linalg.norm(place_m - other_m) > reach_m / 3 for other_m in taken):
            taken.append(place_m)
            yield MapScan(m, seen, place_m, reach_m)
        if len(taken) == RULES.whole_stretches:
            return
