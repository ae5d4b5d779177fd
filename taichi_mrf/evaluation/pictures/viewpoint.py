"""From where to look at a whole map so that its inside is seen best."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.surfaces import cell_keys, mean_vectors
from taichi_mrf.evaluation.pictures.voxel_raster import cast_voxels
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

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
    """Which voxels (N, 3) show the side that was seen to a viewer at ``eye`` (3,) in metres.

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
