"""A pattern that is printed on every surface of a scene, for what looks at colour.

It is value noise in space: random numbers at the corners of cubes, interpolated between them, in three sizes
of cubes. So a surface looks the same from everywhere.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.origins import points_at

CUBES_M = (0.4, 0.13, 0.045)
"""Sides of the cubes in metres."""

CONTRAST = 0.35
"""The largest share by which each size makes paint brighter or darker."""

_PERIOD = 64
"""The numbers repeat after so many cubes."""


def mottled(
    picture: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, T_world_camera: Pose
) -> NDArray[np.uint8]:
    """A colour picture, (H, W, 3), with the pattern on all surfaces at their axial depth, (H, W) metres."""
    points_m = points_at(camera, depth_m) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    shaded = picture * pattern(points_m, depth_m / camera.fx)[..., None]
    return np.clip(np.round(shaded), 0, 255).astype(np.uint8)


def pattern(points_m: NDArray[np.floating], pixel_m: NDArray[np.floating]) -> NDArray[np.float32]:
    """(...): the factor on the brightness of points (..., 3) of the world, of which a pixel covers
    ``pixel_m`` (...) metres. Cubes smaller than two pixels fade away, as a lens would have it."""
    factor = np.ones(points_m.shape[:-1], np.float32)
    for cube_m in CUBES_M:
        shown = np.clip(cube_m / (2 * np.maximum(pixel_m, 1e-9)) - 1, 0, 1).astype(np.float32)
        factor *= 1 + CONTRAST * shown * (2 * _value_noise(points_m / cube_m) - 1)
    return factor


def _value_noise(at: NDArray[np.floating]) -> NDArray[np.float32]:
    """(...): between 0 and 1 at places (..., 3), in sides of a cube."""
    cell = np.floor(at)
    share = (at - cell).astype(np.float32)
    share = share * share * (3 - 2 * share)
    corners = [(cell.astype(np.int64) + side) % _PERIOD for side in (0, 1)]
    weights = 1 - share, share
    value = np.zeros(at.shape[:-1], np.float32)
    for x, y, z in np.ndindex(2, 2, 2):
        weight = weights[x][..., 0] * weights[y][..., 1] * weights[z][..., 2]
        value += weight * _numbers()[corners[x][..., 0], corners[y][..., 1], corners[z][..., 2]]
    return value


@lru_cache(maxsize=1)
def _numbers() -> NDArray[np.float32]:
    return np.random.default_rng(0).random((_PERIOD,) * 3, np.float32)
