"""Target of a click into the scene: a voxel, or a pixel of a keyframe's picture."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.viewer.messages import KeyframeInfo
from taichi_mrf.viewer.scene.keyframe_layer import FRUSTUM_M, RING_M, hits_of_sphere, on_sphere


@dataclass(frozen=True)
class Pixel:
    """A pixel of a keyframe's picture, and its distance from the viewpoint in metres. ``point`` (3,), in the
    world, is on the picture if that is not flat; its pixels are then not those of the keyframe's image."""

    keyframe: int
    u: float
    v: float
    range_m: float
    point: NDArray[np.float64] | None = None


def first_voxel(
    origin: ArrayLike, direction: ArrayLike, centres: NDArray[np.float64], side_m: float
) -> tuple[NDArray[np.float64], float] | None:
    """The centre of the nearest voxel that a ray hits, and its range in metres, of those with these centres
    (n, 3) and this side.

    The ray hits a voxel if it passes the centre at no more than half the diagonal of a face: about the size
    of the voxel's point on the screen.
    """
    start = np.asarray(origin, np.float64)
    along = np.asarray(direction, np.float64)
    along = along / np.linalg.norm(along)
    offset = centres - start
    range_m = offset @ along
    aside = np.linalg.norm(offset - range_m[:, None] * along, axis=1)
    met = np.flatnonzero((range_m > 0) & (aside <= np.sqrt(0.5) * side_m))
    if not len(met):
        return None
    first = met[np.argmin(range_m[met])]
    return centres[first], float(range_m[first])


def first_pixel(origin: ArrayLike, direction: ArrayLike, keyframes: Iterable[KeyframeInfo]) -> Pixel | None:
    """The pixel that a ray hits first, of all pictures of keyframes."""
    start = np.asarray(origin, np.float64)
    along = np.asarray(direction, np.float64)
    along = along / np.linalg.norm(along)
    hits = [hit for keyframe in keyframes if (hit := _pixel(start, along, keyframe)) is not None]
    return min(hits, key=lambda hit: hit.range_m, default=None)


def _pixel(start: NDArray[np.float64], along: NDArray[np.float64], keyframe: KeyframeInfo) -> Pixel | None:
    """The pixel where the ray crosses the picture, which stands FRUSTUM_M in front of the keyframe's
    camera, or lies on a sphere of radius RING_M around it."""
    R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
    origin, direction = R.T @ (start - t), R.T @ along
    if not isinstance(keyframe.camera, PinholeCamera):
        return _pixel_on_sphere(keyframe, origin, direction)
    if abs(direction[2]) < 1e-9:
        return None
    range_m = (FRUSTUM_M - origin[2]) / direction[2]
    x, y = (origin + range_m * direction)[:2] / FRUSTUM_M
    camera = keyframe.camera
    u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    inside = -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5
    return Pixel(keyframe.id, float(u), float(v), float(range_m)) if inside and range_m > 0 else None


def _pixel_on_sphere(
    keyframe: KeyframeInfo, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> Pixel | None:
    """The nearer of the sphere's sides that has a pixel where the ray, in the camera frame, crosses it."""
    if origins_of(keyframe.camera) is not None:
        return _pixel_of_moving(keyframe, origin, direction)
    for range_m in hits_of_sphere(origin, direction, RING_M):
        point = origin + range_m * direction
        u, v, _ = keyframe.camera.project(point[None])[0]
        if not np.isnan(u):
            R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
            return Pixel(keyframe.id, float(u), float(v), range_m, R @ point + t)
    return None


def _pixel_of_moving(
    keyframe: KeyframeInfo, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> Pixel | None:
    """The pixel that the ray, in the camera frame, passes at no more than about a pixel's width, on the
    nearer side of what is a sphere if the camera does not move."""
    points = on_sphere(keyframe.camera, RING_M).reshape(-1, 3).astype(np.float64)
    range_m = (points - origin) @ direction
    aside = np.linalg.norm(points - origin - range_m[:, None] * direction, axis=1)
    width_m = RING_M * np.sqrt(4 * np.pi / len(points))
    met = np.flatnonzero((range_m > 0) & (aside < width_m))
    if not len(met):
        return None
    near = met[range_m[met] < range_m[met].min() + width_m]
    best = int(near[np.argmin(aside[near])])
    v, u = divmod(best, keyframe.camera.width)
    R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
    return Pixel(keyframe.id, float(u), float(v), float(range_m[best]), R @ points[best] + t)
