"""Pictures of a whole map from outside: the viewpoint that shows its inside best, camera, light, background,
colours of heights.
"""

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.figures import color_bar, new_figure
from taichi_mrf.evaluation.pictures.raster import cast_voxels
from taichi_mrf.evaluation.pictures.surfaces import cell_keys, mean_vectors
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_AZIMUTHS = 12
_ELEVATIONS_DEG = (35.0, 45.0)
_BACK = -0.2
"""Cosine between a normal and the direction to the viewer below which a surface shows its back. Between
that of a mean normal at an edge with one face in view (-0.12 from the lower elevation), which must stay,
and of a ceiling at the far end of the picture (-0.3), which must go."""

_CANDIDATE_WIDTH = 160
_CANDIDATE_CELLS = 30_000


def faces_viewer(
    centres: NDArray[np.floating], normals: NDArray[np.floating], eye: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """True for voxels (N, 3) whose observed side faces a viewer at ``eye`` (3,) in metres.

    Without the others a room looks like a doll's house: the near walls and the ceiling, of which a
    viewer outside would see the back, are gone. A voxel without a normal (0) is kept.
    """
    towards_eye = eye - centres
    cosine = np.einsum("ij,ij->i", normals, towards_eye) / np.linalg.norm(towards_eye, axis=1)
    return cosine > _BACK


def overview_pose(
    centres: NDArray[np.floating],
    normals: NDArray[np.floating],
    up: NDArray[np.floating],
    camera: PinholeCamera,
    voxel_size: float,
) -> Pose:
    """T_world_camera of the view from outside and above that shows most of the seen surfaces.

    ``centres`` and ``normals`` are (N, 3), N at least 1. Of the candidates all around, that one wins
    whose pixels show the most surface, each weighed by how squarely it is looked at.
    """
    cells, cell_normals, cell_size = _coarse(centres, normals, voxel_size)
    small = camera.scaled(_CANDIDATE_WIDTH / camera.width)
    east = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.7 else [0.0, 1.0, 0.0])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    best, best_score = np.eye(4), -1.0
    for elevation in np.deg2rad(_ELEVATIONS_DEG):
        for azimuth in np.arange(_AZIMUTHS) * (2.0 * np.pi / _AZIMUTHS):
            level = np.cos(azimuth) * east + np.sin(azimuth) * north
            towards_viewer = np.cos(elevation) * level + np.sin(elevation) * up
            pose = _framed(cells, cell_size, towards_viewer, up, small)
            score = _shown_surface(cells, cell_normals, cell_size, small, pose)
            if score > best_score:
                best, best_score = pose, score
    return best


def _coarse(
    centres: NDArray[np.floating], normals: NDArray[np.floating], voxel_size: float
) -> tuple[NDArray[np.floating], NDArray[np.floating], float]:
    """Shape of the map in at most _CANDIDATE_CELLS larger cells: what candidates are judged by."""
    cell_size = voxel_size
    while True:
        keys = cell_keys(centres, cell_size)
        distinct, first = np.unique(keys, return_index=True)
        if distinct.size <= _CANDIDATE_CELLS:
            break
        cell_size *= max(1.2, (distinct.size / _CANDIDATE_CELLS) ** 0.5)
    cells = (np.floor(centres[first] / cell_size) + 0.5) * cell_size
    return cells, mean_vectors(keys, normals)[1], cell_size


def _framed(
    points: NDArray[np.floating],
    cell_size: float,
    towards_viewer: NDArray[np.floating],
    up: NDArray[np.floating],
    camera: PinholeCamera,
) -> Pose:
    """The pose that looks against ``towards_viewer`` and fits all points but a few stray ones in."""
    target = np.median(points, axis=0)
    slope = (
        0.94
        * np.array(
            [
                [camera.cx, camera.width - 1 - camera.cx],
                [camera.cy, camera.height - 1 - camera.cy],
            ]
        ).min(axis=1)
        / [camera.fx, camera.fy]
    )
    pose = look_at(target + towards_viewer, target, up)
    R = pose[:3, :3]
    for _ in range(3):  # the distance depends on the middle of the image, and the other way round
        x, y, z = (points - target) @ R[:, 0], (points - target) @ R[:, 1], (points - target) @ R[:, 2]
        distance = max(
            3.0 * cell_size,
            float(np.quantile(np.abs(x) / slope[0] - z, 0.995)),
            float(np.quantile(np.abs(y) / slope[1] - z, 0.995)),
        )
        depth = np.maximum(z + distance, 1e-6)
        for axis, coordinate in ((0, x / depth), (1, y / depth)):
            low, high = np.quantile(coordinate, [0.005, 0.995])
            target = target + R[:, axis] * (0.5 * (low + high) * distance)
    pose[:3, 3] = target - R[:, 2] * distance
    return pose


def _shown_surface(
    cells: NDArray[np.floating],
    normals: NDArray[np.floating],
    cell_size: float,
    camera: PinholeCamera,
    pose: Pose,
) -> float:
    """Sum over the pixels of how squarely they look at a seen surface, with the backs left out."""
    front = faces_viewer(cells, normals, pose[:3, 3])
    seen = cast_voxels(cells[front], cell_size, camera, pose)
    hit = seen.index >= 0
    rays = camera.rays()[hit] @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(-np.einsum("ij,ij->i", normals[front][seen.index[hit]], rays).sum())


PERSPECTIVE = PinholeCamera(width=1400, height=900, fx=1500.0, fy=1500.0, cx=699.5, cy=449.5)

OVERSAMPLING = 2
"""Pixels that are drawn for each of the picture, along each side: their mean has smooth edges."""

LIGHT = np.array([-0.45, -0.6, -0.66])
"""Towards the light, in the frame of the camera: from behind the viewer's left shoulder."""

HEIGHT_COLORS, HEIGHT_LABEL = "Spectral_r", "height above the lowest surface (m)"

_TOP, _BOTTOM = (52, 58, 68), (104, 112, 124)
"""The background at the top and at the bottom: neither white nor black things merge with it."""


def backdrop(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """The background of a picture (H, W, 3), RGB."""
    rows = np.linspace(_TOP, _BOTTOM, shape[0])
    return np.repeat(np.rint(rows).astype(np.uint8)[:, None], shape[1], axis=1)


def height_span(height_m: NDArray[np.floating], least_range_m: float) -> tuple[float, float]:
    """The lowest of heights (N,) in metres, and the range from there to the highest; stray ones do not
    count."""
    floor, top = np.quantile(height_m, [0.005, 0.995]) if height_m.size else (0.0, 0.0)
    return float(floor), max(float(top - floor), least_range_m)


def height_colors(height_m: NDArray[np.floating], least_range_m: float) -> tuple[NDArray[np.uint8], float]:
    """RGB (N, 3) of heights (N,), and the range in metres over which they are coloured."""
    from matplotlib import colormaps

    floor, range_m = height_span(height_m, least_range_m)
    return colormaps[HEIGHT_COLORS]((height_m - floor) / range_m, bytes=True)[:, :3], range_m


def overview(picture: NDArray[np.uint8], title: str, height_range_m: float | None) -> "Figure":
    """The figure of a picture drawn OVERSAMPLING times as large, with the scale of its heights, if any."""
    size = (PERSPECTIVE.width, PERSPECTIVE.height)
    figure = new_figure(13.0, 8.2)
    axes = figure.add_subplot()
    axes.imshow(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), interpolation="antialiased")
    axes.set_title(title)
    axes.axis("off")
    if height_range_m is not None:
        color_bar(axes, HEIGHT_COLORS, 0.0, height_range_m, HEIGHT_LABEL)
    return figure
