"""The surface of a map in one picture, seen from outside through what would be in the way."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.overview import (
    LIGHT,
    OVERSAMPLING,
    PERSPECTIVE,
    backdrop,
    height_colors,
    overview,
)
from taichi_mrf.evaluation.pictures.shading import shaded_triangles
from taichi_mrf.evaluation.pictures.triangle_raster import cast_triangles
from taichi_mrf.evaluation.pictures.viewpoint import overview_pose

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PHOTO_VOXEL_M = 0.02
"""The largest voxels whose surface is drawn in the colours of photographs; on larger ones these smear."""

_BORDER_PASSES = 4


@dataclass(frozen=True)
class DrawnSurface:
    """A surface to draw, world frame, metres: ``vertices_m`` (V, 3), ``triangles`` (T, 3), at least one,
    ``normals`` (V, 3) and ``colors`` (V, 3) RGB, None to colour it by height."""

    vertices_m: NDArray[np.floating]
    triangles: NDArray[np.integer]
    normals: NDArray[np.floating]
    colors: NDArray[np.uint8] | None


def surface_view(surface: DrawnSurface, voxel_size: float, up: NDArray[np.float64]) -> "Figure":
    """The surface under a light, in the colours that cameras saw if voxels are small enough, else by height;
    what faces away from the viewer is not seen."""
    triangles = surface.triangles
    vertices_m = smooth_borders(surface.vertices_m, triangles)
    pose = overview_pose(vertices_m, surface.normals, up, PERSPECTIVE, voxel_size)
    camera = PERSPECTIVE.scaled(OVERSAMPLING)
    image = cast_triangles(vertices_m, triangles, camera, pose)
    colors, height_range = surface.colors, None
    if colors is None or voxel_size > PHOTO_VOXEL_M:
        colors, height_range = height_colors(vertices_m @ up, voxel_size)
    light = pose[:3, :3] @ LIGHT
    picture = shaded_triangles(image, triangles, colors, surface.normals, light, backdrop(camera.shape))
    how = "in the colours of the images" if height_range is None else "by height"
    title = f"the measured surface {how}, voxels of {100 * voxel_size:.3g} cm; what faces away is left out"
    return overview(picture, title, height_range)


def smooth_borders(vertices_m: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.float64]:
    """The vertices (V, 3) with those at borders moved towards their neighbours on them: where a surface ends,
    its triangles end in the steps of the voxels."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1)
    count = len(vertices_m)
    distinct, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    one, other = np.divmod(distinct[uses == 1], count)
    ends, beside = np.concatenate([one, other]), np.concatenate([other, one])
    neighbours = np.bincount(ends, minlength=count)
    border = np.flatnonzero(neighbours)
    smooth = np.array(vertices_m, np.float64)
    for _ in range(_BORDER_PASSES):
        sums = np.stack([np.bincount(ends, smooth[beside, axis], count) for axis in range(3)], axis=1)
        smooth[border] = 0.5 * (smooth[border] + sums[border] / neighbours[border, None])
    return smooth
