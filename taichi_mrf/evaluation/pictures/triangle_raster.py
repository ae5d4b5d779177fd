"""The first triangle that each pixel of a camera sees, from nothing but a list of triangles.

Triangles are seen from the side from which they run counter-clockwise. Each is tested against the pixels of
its projected bounding rectangle (edge functions, Pineda 1988), and the nearest wins.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.voxel_raster import pixels_of_rectangles
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera

_NEAR_M = 0.01
_NOTHING = np.uint64(0x7F800000FFFFFFFF)
"""A depth of infinity (as float32 bits) and no triangle."""


@dataclass(frozen=True)
class TriangleImage:
    """Image of triangles: ``depth_m`` (H, W) axial, NaN where there is nothing; ``index`` (H, W) of the
    triangle, -1 for none; ``shares`` (H, W, 3) of its three corners at the pixel."""

    depth_m: NDArray[np.float32]
    index: NDArray[np.int64]
    shares: NDArray[np.float32]


def cast_triangles(
    vertices_m: NDArray[np.floating],
    triangles: NDArray[np.integer],
    camera: PinholeCamera,
    T_world_camera: Pose,
) -> TriangleImage:
    """Look at triangles (T, 3) between vertices (V, 3), in metres, world. Those that reach behind the camera
    are left out."""
    T = inverse(T_world_camera)
    x, y, depth = (np.asarray(vertices_m, np.float64) @ T[:3, :3].T + T[:3, 3]).T
    ahead = np.maximum(depth, _NEAR_M)
    u, v = camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy
    corners = np.stack([u[triangles], v[triangles]], axis=-1)
    # Rows grow downwards, so counter-clockwise triangles have a negative area in pixels.
    edges = corners[:, 1:] - corners[:, :1]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    first, last = np.ceil(corners.min(axis=1)), np.floor(corners.max(axis=1))
    size = np.array([camera.width, camera.height])
    seen = (area < 0) & (depth[triangles] > _NEAR_M).all(axis=1)
    seen &= (first <= last).all(axis=1) & (last >= 0).all(axis=1) & (first < size).all(axis=1)
    rows = np.flatnonzero(seen)
    bounds = np.clip(np.stack([first[rows], last[rows]], axis=1), 0, size - 1).astype(np.int32)
    box = bounds.transpose(0, 2, 1).reshape(-1, 4)
    words = np.full(camera.width * camera.height, _NOTHING)
    for place, pixel in pixels_of_rectangles(np.arange(len(rows)), box, camera.width):
        row = rows[place]
        shares = _shares(corners[row], area[row], pixel, camera.width)
        inside = (shares >= 0).all(axis=1)
        row, pixel = row[inside], pixel[inside]
        nearness = (shares[inside] / depth[triangles[row]]).sum(axis=1)
        bits = (1.0 / nearness).astype(np.float32).view(np.uint32).astype(np.uint64)
        np.minimum.at(words, pixel, (bits << np.uint64(32)) | row.astype(np.uint64))
    found = (words >> np.uint64(32)).astype(np.uint32).view(np.float32)
    met = np.flatnonzero(np.isfinite(found))
    index = np.full(words.shape, -1, np.int64)
    index[met] = (words[met] & np.uint64(0xFFFFFFFF)).astype(np.int64)
    seen_shares = np.zeros((len(words), 3), np.float32)
    # Shares on the screen become shares in space: nearer corners count more.
    near = _shares(corners[index[met]], area[index[met]], met, camera.width) / depth[triangles[index[met]]]
    seen_shares[met] = near / near.sum(axis=1, keepdims=True)
    depth_m = np.where(np.isfinite(found), found, np.float32(np.nan)).reshape(camera.shape)
    return TriangleImage(depth_m, index.reshape(camera.shape), seen_shares.reshape(*camera.shape, 3))


def _shares(
    corners: NDArray[np.float64], area: NDArray[np.float64], pixel: NDArray[np.integer], width: int
) -> NDArray[np.float64]:
    """The shares of the corners (n, 3, 2) of triangles at pixels (n,), on the screen: (n, 3)."""
    row, column = np.divmod(pixel, width)
    away = corners - np.stack([column, row], axis=1)[:, None]
    opposite = [
        away[:, a, 0] * away[:, b, 1] - away[:, a, 1] * away[:, b, 0] for a, b in ((1, 2), (2, 0), (0, 1))
    ]
    return np.stack(opposite, axis=1) / area[:, None]
