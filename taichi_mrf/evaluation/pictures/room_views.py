"""A whole map in one picture: a plan from above, and a doll's-house view of its voxels or of its surface from
outside, without what would be in the way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.figures import color_bar, draw_camera_path, new_figure
from taichi_mrf.evaluation.pictures.raster import cast_triangles, cast_voxels, shaded, shaded_triangles
from taichi_mrf.evaluation.pictures.surfaces import level_rotation
from taichi_mrf.evaluation.pictures.viewpoint import (
    HEIGHT_COLORS,
    HEIGHT_LABEL,
    LIGHT,
    OVERSAMPLING,
    PERSPECTIVE,
    backdrop,
    faces_viewer,
    height_colors,
    overview,
    overview_pose,
)
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PHOTO_VOXEL_M = 0.02
"""The largest voxels whose surface is drawn in the colours of photographs; on larger ones these smear."""

_BORDER_PASSES = 4


@dataclass(frozen=True)
class DrawnSurface:
    """A surface to draw, world frame, metres: ``vertices_m`` (V, 3) with smooth borders, at least one of
    ``triangles`` (T, 3), ``normals`` (V, 3) and ``colors`` (V, 3) RGB, None to colour it by height."""

    vertices_m: NDArray[np.floating]
    triangles: NDArray[np.integer]
    normals: NDArray[np.floating]
    colors: NDArray[np.uint8] | None


def surface_view(surface: DrawnSurface, voxel_size: float, up: NDArray[np.float64]) -> "Figure":
    """The surface under a light, in the colours that cameras saw if voxels are small enough, else by height;
    what faces away from the viewer is not seen."""
    triangles = surface.triangles
    vertices_m = surface.vertices_m
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
    count, following = len(vertices_m), triangles[:, [1, 2, 0]]
    edges = np.minimum(triangles, following).astype(np.int64) * count + np.maximum(triangles, following)
    distinct, uses = np.unique(edges, return_counts=True)
    one, other = np.divmod(distinct[uses == 1], count)
    ends, beside = np.concatenate([one, other]), np.concatenate([other, one])
    neighbours = np.bincount(ends, minlength=count)
    border = np.flatnonzero(neighbours)
    smooth = np.array(vertices_m, np.float64)
    for _ in range(_BORDER_PASSES):
        sums = np.stack([np.bincount(ends, smooth[beside, axis], count) for axis in range(3)], axis=1)
        smooth[border] = 0.5 * (smooth[border] + sums[border] / neighbours[border, None])
    return smooth


_PLAN_PIXELS = 1200
"""Longer side of the plan."""

_PLAN_SIZE_IN = 10.0
_SURFACE = "the measured surface"


@dataclass(frozen=True)
class DrawnMap:
    """Parts of a map that are drawn, world frame, metres. At least one voxel, unless its surface is drawn."""

    centres: NDArray[np.floating]
    """Centres of the occupied voxels, (N, 3)."""

    normals: NDArray[np.floating]
    """Mean normals of the surfaces that they belong to, (N, 3), 0 where unknown."""

    voxel_size: float
    """Side of a voxel."""

    up: NDArray[np.float64]
    """Unit vector that points up, (3,)."""

    T_world_cameras: Sequence[Pose]
    """Poses of the keyframes, in their order."""


def top_view(room: DrawnMap, surface: DrawnSurface | None = None) -> "Figure":
    """The surface seen from above, or the voxels where there is none, coloured by height, with the camera's
    path.

    The axes are those of the world frame, turned by as little as makes them level.
    """
    R_level_world = level_rotation(room.up)
    level = (room.centres if surface is None else surface.vertices_m) @ R_level_world.T
    eyes = np.array([R_level_world @ T[:3, 3] for T in room.T_world_cameras]).reshape(-1, 3)
    low, high = np.quantile(level, [0.01, 0.99], axis=0)  # without what a lidar saw through a door
    if len(eyes):
        low[:2], high[:2] = np.minimum(low, eyes.min(axis=0))[:2], np.maximum(high, eyes.max(axis=0))[:2]
    margin = 0.03 * (high - low)[:2].max() + room.voxel_size
    low[:2], high[:2] = low[:2] - margin, high[:2] + margin
    camera, pose = _camera_above(0.5 * (low + high), (high - low)[:2], R_level_world)
    if surface is None:
        what, (picture, height_range) = _voxels(room), _voxels_from_above(room, level[:, 2], camera, pose)
    else:
        what, (picture, height_range) = _SURFACE, _surface_from_above(surface, room, camera, pose)

    width_in, height_in = _PLAN_SIZE_IN * np.clip(
        np.array([camera.width, camera.height]) / _PLAN_PIXELS, 0.4, 1.0
    )
    figure = new_figure(width_in + 1.6, height_in + 1.2)
    axes = figure.add_subplot()
    axes.imshow(picture, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased")
    draw_camera_path(axes, eyes[:, :2])
    axes.set(xlabel="metres", ylabel="metres", title=f"{what} from above, ceilings left out")
    color_bar(axes, HEIGHT_COLORS, 0.0, height_range, HEIGHT_LABEL)
    return figure


def _voxels_from_above(
    room: DrawnMap, height_m: NDArray[np.floating], camera: PinholeCamera, pose: Pose
) -> tuple[NDArray[np.uint8], float]:
    """The picture (H, W, 3), RGB, and the range of its heights in metres."""
    # Surfaces that were seen from below (ceilings, undersides) would hide the room.
    open_above = room.normals @ room.up > -0.5
    colors, height_range = height_colors(height_m[open_above], room.voxel_size)
    image = cast_voxels(room.centres[open_above], room.voxel_size, camera, pose)
    return shaded(image, colors, room.normals[open_above], _light(room.up), _white(camera)), height_range


def _surface_from_above(
    surface: DrawnSurface, room: DrawnMap, camera: PinholeCamera, pose: Pose
) -> tuple[NDArray[np.uint8], float]:
    """Picture of the surface from above and its range of heights; what was seen from below faces away."""
    triangles, vertices_m = surface.triangles, surface.vertices_m
    colors, height_range = height_colors(vertices_m @ room.up, room.voxel_size)
    image = cast_triangles(vertices_m, triangles, camera, pose)
    picture = shaded_triangles(image, triangles, colors, surface.normals, _light(room.up), _white(camera))
    return picture, height_range


def _light(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Towards the light of a plan, in the world."""
    return np.array([-0.4, 0.5, 0.77]) @ level_rotation(up)


def _white(camera: PinholeCamera) -> NDArray[np.uint8]:
    return np.full((*camera.shape, 3), 255, np.uint8)


def perspective(room: DrawnMap) -> "Figure":
    """The voxels by height, seen from outside through what would be in the way."""
    pose = overview_pose(room.centres, room.normals, room.up, PERSPECTIVE, room.voxel_size)
    colors, height_range = height_colors(room.centres @ room.up, room.voxel_size)
    picture = voxels_from(room, pose, colors)
    return overview(picture, f"{_voxels(room)}, surfaces that face away left out", height_range)


def voxels_from(room: DrawnMap, pose: Pose, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Picture (H, W, 3), RGB, OVERSAMPLING times as large as PERSPECTIVE's, of the voxels in their ``colors``
    (N, 3) as seen from a pose (4, 4) T_world_camera, without what faces away."""
    front = faces_viewer(room.centres, room.normals, pose[:3, 3])
    camera = PERSPECTIVE.scaled(OVERSAMPLING)
    image = cast_voxels(room.centres[front], room.voxel_size, camera, pose)
    light = pose[:3, :3] @ LIGHT
    return shaded(image, colors[front], room.normals[front], light, backdrop(camera.shape))


def _voxels(room: DrawnMap) -> str:
    return f"{len(room.centres):,} occupied voxels of {100 * room.voxel_size:.3g} cm"


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
