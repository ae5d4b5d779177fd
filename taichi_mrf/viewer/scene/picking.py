"""What a click into the scene meets: a voxel, or a pixel of a keyframe's picture."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.viewer.messages import KeyframeInfo
from taichi_mrf.viewer.scene.keyframe_layer import FRUSTUM_M


@dataclass(frozen=True)
class Pixel:
    """A pixel of a keyframe's picture, and its range from the eye in metres."""

    keyframe: int
    u: float
    v: float
    range_m: float


def first_voxel(
    origin: ArrayLike, direction: ArrayLike, centres: NDArray[np.float64], voxel_size: float
) -> tuple[NDArray[np.float64], float] | None:
    """The nearest of the voxels with these centres (n, 3) that a ray meets, and its range.

    A voxel counts as met if the ray passes its centre by no more than half a diagonal of a face, which is
    about how far its point reaches on the screen.
    """
    start = np.asarray(origin, np.float64)
    along = np.asarray(direction, np.float64)
    along = along / np.linalg.norm(along)
    offset = centres - start
    range_m = offset @ along
    aside = np.linalg.norm(offset - range_m[:, None] * along, axis=1)
    met = np.flatnonzero((range_m > 0) & (aside <= voxel_size * np.sqrt(0.5)))
    if not len(met):
        return None
    first = met[np.argmin(range_m[met])]
    return centres[first], float(range_m[first])


def first_pixel(origin: ArrayLike, direction: ArrayLike, keyframes: Iterable[KeyframeInfo]) -> Pixel | None:
    """The nearest picture of a keyframe that a ray meets, and the pixel there."""
    start = np.asarray(origin, np.float64)
    along = np.asarray(direction, np.float64)
    along = along / np.linalg.norm(along)
    hits = [hit for keyframe in keyframes if (hit := _pixel(start, along, keyframe)) is not None]
    return min(hits, key=lambda hit: hit.range_m, default=None)


def _pixel(start: NDArray[np.float64], along: NDArray[np.float64], keyframe: KeyframeInfo) -> Pixel | None:
    """Where the ray goes through the picture, which stands FRUSTUM_M before the keyframe's camera."""
    R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
    origin, direction = R.T @ (start - t), R.T @ along
    if abs(direction[2]) < 1e-9:
        return None
    range_m = (FRUSTUM_M - origin[2]) / direction[2]
    x, y = (origin + range_m * direction)[:2] / FRUSTUM_M
    camera = keyframe.camera
    u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    inside = -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5
    return Pixel(keyframe.id, float(u), float(v), float(range_m)) if inside and range_m > 0 else None
