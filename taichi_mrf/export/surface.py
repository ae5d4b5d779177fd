"""The surface of a map as triangles: the outsides of its voxels, or marching cubes through their marginals.

Both go through the map chunk by chunk, so that memory is bounded by the surface, not by the space around it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import BoxOfVoxels, voxel_box
from taichi_mrf.queries.cells import CellReader
from taichi_mrf.queries.colored import blended_colors, shown_colors
from taichi_mrf.queries.known_bricks import BrickReader, sorted_bricks
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels.colors import MARGINAL_NOTE, PHOTO_NOTE, marginal_colors
from taichi_mrf.voxels.layout import CHUNK, CHUNK_VOXELS

_ON_GRID = 2e-5
"""In voxels: a vertex so near to a voxel's centre lies on it."""

_SHIFT = 1 << 17
"""Makes the coordinates of any voxel positive; they then have 18 bits."""

_SIDES = (
    (0, -1, ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0))),
    (0, 1, ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1))),
    (1, -1, ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1))),
    (1, 1, ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0))),
    (2, -1, ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0))),
    (2, 1, ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))),
)
"""The six sides of a voxel: axis, direction, and corners counter-clockwise as seen from outside."""


@dataclass(frozen=True)
class Surface:
    """Triangles in the world: ``vertices_m`` (V, 3) float64 in metres, ``triangles`` (T, 3) int64, wound
    counter-clockwise as seen from free space, ``colors`` (V, 3) uint8, whose meaning is ``colors_note``. What
    keyframes have measured has ``normals`` (V, 3) and standard deviations ``std_m`` (V,) too."""

    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int64]
    colors: NDArray[np.uint8]
    colors_note: str = MARGINAL_NOTE
    normals: NDArray[np.float32] | None = None
    std_m: NDArray[np.float32] | None = None


def voxel_surface(m: VoxelMap, threshold: float, cells: bool = False) -> Surface:
    """The outsides of all voxels of at least this probability, with ``cells`` also of those in cells that
    stand in for voxels (queries/cells.py); each side has its own four vertices."""
    corners, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for found in _chunks(m, 1, False, CellReader(m, threshold) if cells else BrickReader(m)):
        p = _seen_probability(m, found)
        solid = p >= threshold
        inner = (slice(1, -1),) * 3
        for axis, direction, side in _SIDES:
            beyond = list(inner)
            beyond[axis] = slice(1 + direction, CHUNK_VOXELS + 1 + direction)
            voxels = np.argwhere(solid[inner] & ~solid[tuple(beyond)])
            lower = voxels + found.lowest + 1
            corners.append((lower[:, None] + np.array(side)).reshape(-1, 3) * m.voxel_size)
            colors.append(np.repeat(marginal_colors(p[inner][tuple(voxels.T)]), 4, axis=0))
    vertices = np.concatenate(corners)
    first = 4 * np.arange(len(vertices) // 4)[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])], axis=1).reshape(
        -1, 3
    )
    return Surface(vertices, triangles, np.concatenate(colors))


def photographed(m: VoxelMap, surface: Surface, of_voxels: bool) -> Surface:
    """The surface in the colours that cameras saw. ``of_voxels``: it is a :func:`voxel_surface`."""
    if of_voxels:
        corners = surface.vertices_m.reshape(-1, 4, 3)
        outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]) / m.voxel_size**2
        centres = corners.mean(axis=1) - 0.5 * m.voxel_size * outwards
        colors = np.repeat(shown_colors(m, centres), 4, axis=0)
    else:
        colors = blended_colors(m, surface.vertices_m)
    return replace(surface, colors=colors, colors_note=PHOTO_NOTE)


def smooth_surface(m: VoxelMap, level: float) -> Surface:
    """Surface where the marginal is ``level``: marching cubes (Lewiner et al. 2003) between voxels' centres.
    Unknown space counts as empty."""
    from skimage import measure  # slow to import

    vertices, triangles, values = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.float32)]
    count = 0
    for found in _chunks(m, 0, True, BrickReader(m)):
        p = _seen_probability(m, found)
        solid = np.argwhere(p > level)
        if not len(solid):
            continue
        first = np.maximum(solid.min(axis=0) - 1, 0)
        after = np.minimum(solid.max(axis=0) + 2, p.shape)
        part = np.ascontiguousarray(p[tuple(slice(a, b) for a, b in zip(first, after, strict=True))])
        if part.min() > level or min(part.shape) < 2:
            continue
        # From below the level to above it is inwards.
        points, faces, _, _ = measure.marching_cubes(part, level, gradient_direction="ascent")
        vertices.append(points.astype(np.float64) + first + found.lowest)
        triangles.append(faces.astype(np.int64) + count)
        values.append(_largest_around(points, part))
        count += len(points)
    points = np.concatenate(vertices)
    kept, faces = welded_rows(points, np.concatenate(triangles))
    return Surface((points[kept] + 0.5) * m.voxel_size, faces, marginal_colors(np.concatenate(values)[kept]))


def _largest_around(points: NDArray[np.float32], p: NDArray[np.float32]) -> NDArray[np.float32]:
    """The largest probability among the voxels that each point lies between, (n, 3) -> (n,)."""
    ends = np.floor(points).astype(np.int64), np.ceil(points).astype(np.int64)
    corners = [[ends[side][:, axis] for axis, side in enumerate(sides)] for sides in np.ndindex(2, 2, 2)]
    return np.max([p[tuple(corner)] for corner in corners], axis=0)


def _chunks(m: VoxelMap, margin: int, reach_back: bool, reader: BrickReader) -> Iterator[BoxOfVoxels]:
    """The chunks that hold voxels, with ``margin`` voxels around them, or with ``reach_back`` one voxel more
    behind them, and with them the chunks before them, whose cells reach into them.

    Raises ConfigError for a map without voxels.
    """
    if not len(reader.bricks):
        raise ConfigError("the map is empty: it has no surface")
    chunks = sorted_bricks(reader.bricks // CHUNK)
    if reach_back:
        before = [chunks - np.array(step, np.int32) for step in np.ndindex(2, 2, 2)]
        chunks = sorted_bricks(np.concatenate(before))
    for chunk in chunks.astype(np.int64):
        first = chunk * CHUNK_VOXELS
        yield voxel_box(m, first - margin, first + CHUNK_VOXELS + max(margin, int(reach_back)), reader)


def _seen_probability(m: VoxelMap, found: BoxOfVoxels) -> NDArray[np.float32]:
    """Marginals, 0 for unknown voxels: their prior may be one half, which is no surface."""
    return np.where(found.log_odds == m.view.pool.prior_log_odds, np.float32(0), found.occupancy)


def welded_rows(
    points: NDArray[np.float64], triangles: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """One vertex where those of two chunks are the same: on the same edge between two voxels' centres.

    ``points`` (V, 3) count voxels' centres. Returns the rows of those that stay, and the triangles (T, 3) of
    them, without those that have no area.
    """
    nearest = np.rint(points)
    off = np.abs(points - nearest)
    axis = off.argmax(axis=1)
    rows = np.arange(len(points))
    off_grid = off[rows, axis] > _ON_GRID
    cell = nearest.astype(np.int64)
    cell[rows[off_grid], axis[off_grid]] = np.floor(points[rows[off_grid], axis[off_grid]]).astype(np.int64)
    code = cell + _SHIFT
    key = (code[:, 0] << 38 | code[:, 1] << 20 | code[:, 2] << 2) | np.where(off_grid, axis, 3)
    inside = (off > _ON_GRID).sum(axis=1) > 1  # of a cell, which no other chunk has
    key[inside] = -1 - rows[inside]
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    triangles = place.reshape(-1)[triangles]
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    return first, triangles[~flat]
