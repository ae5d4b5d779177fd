"""The whole map in one picture: a plan from above, and doll's-house views of its voxels and its surface."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.figures import color_bar, draw_way, new_figure
from taichi_mrf.evaluation.pictures.shading import shaded, shaded_triangles
from taichi_mrf.evaluation.pictures.surfaces import level_rotation
from taichi_mrf.evaluation.pictures.triangle_raster import cast_triangles
from taichi_mrf.evaluation.pictures.viewpoint import faces_viewer, overview_pose
from taichi_mrf.evaluation.pictures.voxel_raster import cast_voxels
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.voxels.colors import LOWEST, marginal_colors, viridis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PERSPECTIVE = PinholeCamera(width=1400, height=900, fx=1500.0, fy=1500.0, cx=699.5, cy=449.5)
_OVERSAMPLING = 1.5
_PLAN_PIXELS = 1200
"""Longer side of the plan."""

_PLAN_SIZE_IN = 10.0


@dataclass(frozen=True)
class DrawnMap:
    """What is drawn of a map, world frame, metres. At least one voxel."""

    centres: NDArray[np.floating]
    """Centres of the occupied voxels, (N, 3)."""

    probability: NDArray[np.floating]
    """Their marginals, (N,)."""

    normals: NDArray[np.floating]
    """Mean normals of the surfaces that they belong to, (N, 3), 0 where unknown."""

    voxel_size: float
    """Side of a voxel."""

    up: NDArray[np.float64]
    """Unit vector that points up, (3,)."""

    T_world_cameras: Sequence[Pose]
    """Where the keyframes were taken, in their order."""

    of_cells: int = 0
    """How many of the voxels belong to cells that stand in for them (queries/cells.py)."""


def top_view(room: DrawnMap) -> "Figure":
    """The voxels seen from above, coloured by height, with the way of the camera.

    The axes are those of the world frame, turned by as little as makes them level.
    """
    from matplotlib import colormaps

    R_level_world = level_rotation(room.up)
    level = room.centres @ R_level_world.T
    way = np.array([R_level_world @ T[:3, 3] for T in room.T_world_cameras]).reshape(-1, 3)
    low, high = np.quantile(level, [0.002, 0.998], axis=0)
    if len(way):
        low[:2], high[:2] = np.minimum(low, way.min(axis=0))[:2], np.maximum(high, way.max(axis=0))[:2]
    margin = 0.03 * (high - low)[:2].max() + room.voxel_size
    low[:2], high[:2] = low[:2] - margin, high[:2] + margin
    # Surfaces that were seen from below (ceilings, undersides) would hide the room.
    open_above = room.normals @ room.up > -0.5
    height = level[open_above, 2]
    floor, top = np.quantile(height, [0.005, 0.995]) if height.size else (0.0, 0.0)
    height_range = max(float(top - floor), room.voxel_size)
    colors = colormaps["Spectral_r"]((height - floor) / height_range, bytes=True)[:, :3]
    camera, pose = _camera_above(0.5 * (low + high), (high - low)[:2], R_level_world)
    image = cast_voxels(room.centres[open_above], room.voxel_size, camera, pose)
    light = np.array([-0.4, 0.5, 0.77]) @ R_level_world
    picture = shaded(image, colors, room.normals[open_above], light)

    width_in, height_in = _PLAN_SIZE_IN * np.clip(
        np.array([camera.width, camera.height]) / _PLAN_PIXELS, 0.4, 1.0
    )
    figure = new_figure(width_in + 1.6, height_in + 1.2)
    axes = figure.add_subplot()
    axes.imshow(picture, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased")
    draw_way(axes, way[:, :2])
    axes.set(xlabel="metres", ylabel="metres", title=f"{_voxels(room)} from above, ceilings left out")
    color_bar(axes, "Spectral_r", 0.0, height_range, "height above the lowest surface (m)")
    return figure


def perspective(room: DrawnMap) -> "Figure":
    """The voxels coloured by marginal, seen from outside through what would be in the way."""
    from matplotlib.colors import ListedColormap

    pose = overview_pose(room.centres, room.normals, room.up, _PERSPECTIVE, room.voxel_size)
    front = faces_viewer(room.centres, room.normals, pose[:3, 3])
    fine_camera = _PERSPECTIVE.scaled(_OVERSAMPLING)
    image = cast_voxels(room.centres[front], room.voxel_size, fine_camera, pose)
    light = pose[:3, :3] @ [-0.45, -0.6, -0.66]  # from behind the viewer's left shoulder
    colors = marginal_colors(room.probability[front])
    picture = shaded(image, colors, room.normals[front], light)
    picture = cv2.resize(picture, (_PERSPECTIVE.width, _PERSPECTIVE.height), interpolation=cv2.INTER_AREA)

    way = np.array([(inverse(pose) @ T[:, 3])[:3] for T in room.T_world_cameras]).reshape(-1, 3)
    way = way[way[:, 2] > 0]
    u = _PERSPECTIVE.fx * way[:, 0] / way[:, 2] + _PERSPECTIVE.cx
    v = _PERSPECTIVE.fy * way[:, 1] / way[:, 2] + _PERSPECTIVE.cy
    figure = new_figure(13.0, 8.2)
    axes = figure.add_subplot()
    axes.imshow(picture, interpolation="antialiased")
    draw_way(axes, np.stack([u, v], axis=-1))
    axes.set(xlim=(-0.5, _PERSPECTIVE.width - 0.5), ylim=(_PERSPECTIVE.height - 0.5, -0.5))
    axes.set_title(f"{_voxels(room)}, surfaces that face away from the viewer left out")
    axes.axis("off")
    color_bar(axes, ListedColormap(viridis() / 255.0), LOWEST, 1.0, "marginal occupancy")
    return figure


@dataclass(frozen=True)
class DrawnSurface:
    """A surface to draw, world frame, metres: ``vertices_m`` (V, 3), ``triangles`` (T, 3), at least one,
    ``normals`` (V, 3) and ``colors`` (V, 3) RGB, None to colour it by height."""

    vertices_m: NDArray[np.floating]
    triangles: NDArray[np.integer]
    normals: NDArray[np.floating]
    colors: NDArray[np.uint8] | None


def surface_view(surface: DrawnSurface, voxel_size: float, up: NDArray[np.float64]) -> "Figure":
    """The surface in the colours that cameras saw, or by height and under a light, from outside; what faces
    away from the viewer is not seen."""
    from matplotlib import colormaps

    vertices, triangles, normals = surface.vertices_m, surface.triangles, surface.normals
    pose = overview_pose(vertices, normals, up, _PERSPECTIVE, voxel_size)
    image = cast_triangles(vertices, triangles, _PERSPECTIVE.scaled(_OVERSAMPLING), pose)
    height = vertices @ up
    floor, top = np.quantile(height, [0.005, 0.995])
    height_range = max(float(top - floor), voxel_size)
    colors = surface.colors
    if colors is None:
        colors = colormaps["Spectral_r"]((height - floor) / height_range, bytes=True)[:, :3]
    light = pose[:3, :3] @ [-0.45, -0.6, -0.66]  # from behind the viewer's left shoulder
    picture = shaded_triangles(image, triangles, colors, normals if surface.colors is None else None, light)
    picture = cv2.resize(picture, (_PERSPECTIVE.width, _PERSPECTIVE.height), interpolation=cv2.INTER_AREA)
    figure = new_figure(13.0, 8.2)
    axes = figure.add_subplot()
    axes.imshow(picture, interpolation="antialiased")
    axes.set_title(f"the measured surface, {len(triangles):,} triangles; those that face away are not seen")
    axes.axis("off")
    if surface.colors is None:
        color_bar(axes, "Spectral_r", 0.0, height_range, "height above the lowest surface (m)")
    return figure


def _voxels(room: DrawnMap) -> str:
    own = f"{len(room.centres) - room.of_cells:,} occupied voxels of {100 * room.voxel_size:.3g} cm"
    return f"{own}, and cells that stand in for {room.of_cells:,}" if room.of_cells else own


def _camera_above(
    centre: NDArray[np.floating], size: NDArray[np.floating], R_level_world: NDArray[np.float64]
) -> tuple[PinholeCamera, Pose]:
    """A camera that looks down from so far that its picture is a plan (at the edge 1/300 off plumb).

    ``centre`` (3,) and ``size`` (2,) of the plan are in metres, level frame.
    """
    distance = 150.0 * float(size.max())
    pixel = float(size.max()) / _PLAN_PIXELS
    width, height = (max(1, round(float(s) / pixel)) for s in size)
    focal = distance / pixel
    camera = PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    pose = np.eye(4)
    pose[:3, :3] = R_level_world.T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = R_level_world.T @ (centre + np.array([0.0, 0.0, distance]))
    return camera, pose
