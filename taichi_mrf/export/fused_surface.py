"""The zero level of a field of signed distances as triangles, with a standard deviation for each vertex.

The field is blended where rays are few (voxels/distance_field.py). Triangles are made in cells of whose 8
corners all have weight: where both sides of the surface were seen.

It goes chunk by chunk, so that memory is bounded by the surface, not by the space around it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.datasets.synthetic.mesh_scene import MeshScene, TriangleMesh
from taichi_mrf.export.surface import Surface, welded_rows
from taichi_mrf.geometry.poses import as_pose
from taichi_mrf.queries.colored import marginals_behind
from taichi_mrf.queries.known_bricks import sorted_bricks
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.voxels.colors import marginal_colors
from taichi_mrf.voxels.distance_field import LEAST_WEIGHT, MARGIN, DistanceSource, blended_sums
from taichi_mrf.voxels.layout import CHUNK_VOXELS

RAY_STD = 0.48
"""Standard deviation of a vertex as a multiple of what the weight there gives: blending uses more rays."""

MIXED_STD, MIXED_FAR = 0.067, 36.0
"""And in voxels for each voxel^2 by which squared distances exceed their noise, because rays met different
surfaces; from the second number of voxels^2 on it grows with the root."""

BENT_STD = 1.15
"""In voxels where the surface is bent most: what interpolation between voxels adds."""

COMMON_STD_M = 0.7e-3
"""In metres, everywhere: what no number of rays averages out. All were fitted together on the scenes of
docs/surfaces.md."""

BLENDED_VARIANCE = 0.5
"""Variance in voxels^2 of the distances of 27 voxels with binomial weights, whatever was measured."""


@dataclass(frozen=True)
class FusedSurface:
    """A surface in the world: ``vertices_m`` (V, 3) float64 in metres, ``triangles`` (T, 3) int64, wound
    counter-clockwise as seen from free space, ``normals`` (V, 3) unit vectors towards free space, and
    ``std_m`` (V,) float32, the standard deviation of each vertex along its normal, in metres; ``colors`` (V,
    3) uint8 are what cameras saw, None in a map without colours."""

    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int64]
    normals: NDArray[np.float32]
    std_m: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None

    def render_depth(self, camera: Camera, T_world_camera: ArrayLike) -> NDArray[np.float32]:
        """Axial depth of the surface as a camera at a pose (4, 4) sees it, (H, W) float32 metres, NaN where
        it sees none. OccupancyMap.render_depth has the same depths, and fills the holes. Raises DatasetError
        without embreex."""
        depth_m = self._scene.render_depth(camera, as_pose(T_world_camera))
        return np.where(depth_m > 0, depth_m, np.float32(np.nan))

    @cached_property
    def _scene(self) -> MeshScene:
        return MeshScene(TriangleMesh(self.vertices_m, self.triangles.astype(np.int32)))


def measured_surface(m: VoxelMap) -> Surface:
    """The surface of a map, in the colours of the likeliest marginal at or right behind each vertex."""
    found = m.surface()
    p = marginals_behind(m, found.vertices_m, found.normals)
    return Surface(
        found.vertices_m, found.triangles, marginal_colors(p), normals=found.normals, std_m=found.std_m
    )


def fused_surface(
    field: DistanceSource, voxel_size: float, between: Callable[[], object] = lambda: None
) -> FusedSurface:
    """The surface of a field. ``between`` is called after each chunk."""
    from skimage import measure  # slow to import

    vertices, triangles, variances = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0)]
    count = 0
    for lowest, own, weight, distance, excess in _boxes(field):
        between()
        known = (weight > LEAST_WEIGHT) & (own > 0)
        mean = np.where(known, distance / np.maximum(weight, LEAST_WEIGHT), np.float32(0))
        # marching_cubes looks at the mask of a cell's highest corner.
        whole = np.zeros_like(known)
        whole[1:, 1:, 1:] = _all_corners(known)
        inside, outside = _all_corners(mean >= 0), _all_corners(mean < 0)
        whole[1:, 1:, 1:] &= ~(inside | outside)
        if not whole.any():
            continue
        points, faces, _, _ = measure.marching_cubes(mean, 0.0, mask=whole, gradient_direction="descent")
        vertices.append(points.astype(np.float64) + lowest)
        triangles.append(faces.astype(np.int64) + count)
        variances.append(_ray_variance(points, own, weight, mean, excess))
        count += len(points)
    points = np.concatenate(vertices)
    first, triangles_of = welded_rows(points, np.concatenate(triangles))
    vertices_m = (points[first] + 0.5) * voxel_size
    normals, bent = _normals(vertices_m, triangles_of)
    variance = BENT_STD**2 * bent + np.concatenate(variances)[first]
    std_m = np.sqrt(COMMON_STD_M**2 + voxel_size**2 * variance)
    return FusedSurface(vertices_m, triangles_of, normals, std_m.astype(np.float32))


def without_free(
    surface: FusedSurface,
    voxel_size: float,
    occupancy: Callable[[NDArray[np.float64]], NDArray[np.float32]],
    least: float,
) -> FusedSurface:
    """The surface without what the map takes for free: vertices around which, within 2 voxels along the
    normal, no voxel has the ``occupancy`` ``least``. Rays with a large sigma leave such vertices in front of
    a surface and behind it."""
    step = voxel_size * surface.normals
    likely = np.zeros(len(step), bool)
    for number in (0, -1, 1, -2, 2):
        rows = np.flatnonzero(~likely)
        likely[rows] = occupancy(surface.vertices_m[rows] + number * step[rows]) >= least
    return _of_triangles(surface, np.asarray(likely[surface.triangles].all(axis=1)))


def within_voxels(
    surface: FusedSurface, voxel_size: float, first: NDArray[np.int64], after: NDArray[np.int64]
) -> FusedSurface:
    """The triangles of the cells of some voxels, from ``first`` up to, but without, ``after``, (3,) each; a
    cell lies between the centres of a voxel and the next ones. Surfaces of adjoining boxes meet: they have
    the same vertices there, and no triangle in common."""
    middle = surface.vertices_m[surface.triangles].mean(axis=1) / voxel_size - 0.5
    inside = np.asarray(((middle >= first) & (middle < after)).all(axis=1))
    return _of_triangles(surface, inside)


def _of_triangles(surface: FusedSurface, chosen: NDArray[np.bool_]) -> FusedSurface:
    """Some of a surface's triangles, (T,), and their vertices."""
    triangles = surface.triangles[chosen]
    kept = np.zeros(len(surface.vertices_m), bool)
    kept[triangles] = True
    place = np.cumsum(kept) - 1
    return FusedSurface(
        surface.vertices_m[kept], place[triangles], surface.normals[kept], surface.std_m[kept]
    )


Box = NDArray[np.float32]


def _boxes(field: DistanceSource) -> Iterator[tuple[NDArray[np.int64], Box, Box, Box, Box]]:
    """The lowest voxel of each chunk that holds distances; and for its voxels and those behind it, whose
    cells reach into it, their own weight, and weight, distance and excess times weight after blending."""
    before = [field.chunks - np.array(step, np.int32) for step in np.ndindex(2, 2, 2)]
    side = CHUNK_VOXELS + 1 + 2 * MARGIN
    for chunk in sorted_bricks(np.concatenate([np.zeros((0, 3), np.int32), *before])).astype(np.int64):
        sums = field.box(chunk * CHUNK_VOXELS - MARGIN, side)
        if sums[0].any():
            own = sums[0][(slice(MARGIN, -MARGIN),) * 3]
            weight, distance, excess = blended_sums(*sums)
            yield chunk * CHUNK_VOXELS, own, weight, distance, excess


def _all_corners(true: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True for a cell if all its 8 corners are true; one less along each axis."""
    for axis in range(3):
        true = np.moveaxis(true, axis, 0)
        true = np.moveaxis(true[1:] & true[:-1], 0, axis)
    return true


def _ray_variance(
    points: NDArray[np.float64], own: Box, weight: Box, mean: Box, excess: Box
) -> NDArray[np.float64]:
    """The variance in voxels^2 that measurements leave at points (n, 3) on edges between voxels, (n,), from
    the weight there and from how far distances differ beyond noise and blending."""
    first = np.floor(points).astype(np.int64)
    last = np.ceil(points).astype(np.int64)
    share = (points - first).max(axis=1)
    total, mixed = np.zeros(len(points)), np.zeros(len(points))
    for end, part in ((tuple(first.T), 1 - share), (tuple(last.T), share)):
        gathered = np.maximum(weight[end], LEAST_WEIGHT)
        differ = excess[end] / gathered - mean[end] ** 2 - BLENDED_VARIANCE * (1.0 - own[end] / gathered)
        total += part * gathered
        mixed += part * differ
    mixed = np.maximum(mixed, 0.0)
    return RAY_STD**2 / (16.0 * total) + MIXED_STD**2 * mixed**2 / (1.0 + mixed / MIXED_FAR)


def _normals(
    vertices_m: NDArray[np.float64], triangles: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Unit normals (V, 3) of vertices: those of the triangles around each, by their areas; and how far the
    normals around it differ, two triangles far, (V,): 0 where the surface is flat, at most 1."""
    corners = vertices_m[triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = _sums_around(areas, triangles, len(vertices_m))
    normals = sums / np.maximum(np.linalg.norm(sums, axis=1), 1e-30)[:, None]
    mean, around = normals, np.maximum(np.bincount(triangles.ravel(), minlength=len(normals)), 1)[:, None]
    for _ in range(2):
        mean = _sums_around(mean[triangles].mean(axis=1), triangles, len(normals)) / around
    return normals.astype(np.float32), np.maximum(1.0 - np.linalg.norm(mean, axis=1), 0.0)


def _sums_around(
    values: NDArray[np.float64], triangles: NDArray[np.int64], vertices: int
) -> NDArray[np.float64]:
    """Sums for each vertex of what the triangles around it have, (T, 3)."""
    sums = np.zeros((vertices, 3))
    for axis in range(3):
        for corner in range(3):
            sums[:, axis] += np.bincount(triangles[:, corner], values[:, axis], vertices)
    return sums
