"""Pictures from nothing but a list of voxels or of triangles: the first that each pixel of a camera sees,
exactly, and light on it, so that its shape is legible and its colours still mean something.

Independent of the map and its kernels, so pictures of any voxel list can be drawn, clipped or filtered, on
any machine. Each voxel is tested (slab test) against the pixels of its projected bounding rectangle, near
voxels first; a coarse depth pyramid drops those that are hidden (hierarchical z-buffer, Greene, Kass and
Miller 1993), so a map of millions of voxels takes seconds in NumPy.

Triangles are seen from the side from which they run counter-clockwise. Each is tested against the pixels of
its projected bounding rectangle (edge functions, Pineda 1988), and the nearest wins.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera

_BLOCK = 16
"""Side in pixels of a block of the coarse depth image."""

_VOXELS_AT_ONCE = 100_000
_PAIRS_AT_ONCE = 200_000
"""Bounds the memory of the slab tests to about 10 MB, which fit into the processor's caches."""

_OVERLAP = 1e-5
"""How much larger the cubes are taken, relative to their size: rounding would let rays that run along
a common face slip between its neighbours."""

_NOTHING = np.uint64(0x7F800000FFFFFFFF)
"""A depth of infinity (as float32 bits) and no voxel."""


@dataclass(frozen=True)
class VoxelImage:
    """Image of voxels, all (H, W, ...)."""

    depth_m: NDArray[np.float32]
    """Axial depth of the point where the ray enters the voxel, NaN where it meets none."""

    index: NDArray[np.int64]
    """Index of that voxel in the list, -1 where there is none."""

    normal: NDArray[np.float32]
    """Outward unit normal of the face that the ray enters, (H, W, 3), world frame, 0 where there is none."""


def cast_voxels(
    centres: NDArray[np.floating],
    voxel_size: float,
    camera: PinholeCamera,
    T_world_camera: Pose,
) -> VoxelImage:
    """Cast every pixel's ray against voxels (axis-aligned cubes of the world frame).

    ``centres`` is (N, 3) in metres. Voxels that reach behind the camera or nearer than half a voxel in
    front of it (axial) are left out. The cubes are taken a hundred-thousandth larger, so that none of
    their common faces shows a crack.
    """
    near_m = 0.5 * voxel_size
    half = near_m * (1.0 + _OVERLAP)
    relative, pixel_box, nearest = _footprints(centres, half, camera, T_world_camera, near_m)
    # Directions with z = 1 in the camera frame, so that a ray's parameter is axial depth.
    directions = (camera.rays().reshape(-1, 3) @ T_world_camera[:3, :3].T).astype(np.float32)
    directions[np.abs(directions) < 1e-12] = 1e-12
    inverse = np.ascontiguousarray((1.0 / directions).T)
    # One 64-bit word a pixel: the bits of a positive float32 sort like its value, so the least word is
    # the nearest surface and, among equals, the voxel that comes first.
    words = np.full(camera.width * camera.height, _NOTHING)
    order = np.argsort(nearest)
    order = order[np.isfinite(nearest[order])]
    for start in range(0, order.size, _VOXELS_AT_ONCE):
        voxels = order[start : start + _VOXELS_AT_ONCE]
        voxels = voxels[~_hidden(pixel_box[voxels], nearest[voxels], _depth(words), camera)]
        for voxel, pixel in pixels_of_rectangles(voxels, pixel_box, camera.width):
            enter = np.full(voxel.size, near_m, np.float32)
            leave = np.full(voxel.size, np.inf, np.float32)
            for axis in range(3):
                inverse_axis = inverse[axis, pixel]
                middle, reach = relative[voxel, axis] * inverse_axis, half * np.abs(inverse_axis)
                np.maximum(enter, middle - reach, out=enter)
                np.minimum(leave, middle + reach, out=leave)
            hit = enter <= leave
            depth_bits = enter[hit].view(np.uint32).astype(np.uint64)
            found = (depth_bits << np.uint64(32)) | voxel[hit].astype(np.uint64)
            np.minimum.at(words, pixel[hit], found)
    return _image(words, relative, directions, camera)


def _footprints(
    centres: NDArray[np.floating], half: float, camera: PinholeCamera, T_world_camera: Pose, near_m: float
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]:
    """Centres relative to the camera (N, 3); the pixels that a voxel may cover, as the first and last
    column and row (N, 4); and its nearest depth (N,), infinite where the camera cannot see it."""
    relative = (np.asarray(centres, np.float64) - T_world_camera[:3, 3]).astype(np.float32)
    rotation = T_world_camera[:3, :3].astype(np.float32)
    x, y, z = (relative @ rotation).T
    reach_x, reach_y, reach_z = half * np.abs(rotation).sum(axis=0)
    nearest, farthest = z - reach_z, z + reach_z
    visible = nearest > near_m
    near = np.where(visible, nearest, np.float32(1.0))
    far = np.where(visible, farthest, np.float32(1.0))
    box = np.empty((len(centres), 4), np.int32)
    for column, coordinate, reach, focal, centre, size in (
        (0, x, reach_x, camera.fx, camera.cx, camera.width),
        (2, y, reach_y, camera.fy, camera.cy, camera.height),
    ):
        low, high = coordinate - reach, coordinate + reach
        first = np.ceil(focal * np.minimum(low / near, low / far) + centre - 1e-3)
        last = np.floor(focal * np.maximum(high / near, high / far) + centre + 1e-3)
        visible &= (last >= 0) & (first <= size - 1) & (first <= last)
        box[:, column] = np.clip(first, 0, size - 1)
        box[:, column + 1] = np.clip(last, 0, size - 1)
    return relative, box, np.where(visible, nearest, np.float32(np.inf))


def _depth(words: NDArray[np.uint64]) -> NDArray[np.float32]:
    """The depth half of the pixels' words; infinite where no voxel was met yet."""
    return (words >> np.uint64(32)).astype(np.uint32).view(np.float32)


def _hidden(
    box: NDArray[np.int32],
    nearest: NDArray[np.float32],
    depth: NDArray[np.float32],
    camera: PinholeCamera,
) -> NDArray[np.bool_]:
    """Which voxels lie wholly behind what every block of pixels that they touch already shows, (N,)."""
    rows, columns = -(-camera.height // _BLOCK), -(-camera.width // _BLOCK)
    padded = np.zeros((rows * _BLOCK, columns * _BLOCK), np.float32)
    padded[: camera.height, : camera.width] = depth.reshape(camera.shape)
    farthest = padded.reshape(rows, _BLOCK, columns, _BLOCK).max(axis=(1, 3))
    u0, u1, v0, v1 = (box // _BLOCK).T
    small = (u1 - u0 <= 1) & (v1 - v0 <= 1)  # then the four corners name all blocks that it touches
    corners = [farthest[v, u] for v in (v0, v1) for u in (u0, u1)]
    return small & (nearest > np.maximum.reduce(corners))


def pixels_of_rectangles(
    voxels: NDArray[np.intp], box: NDArray[np.int32], width: int
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """All (voxel, pixel) pairs of the rectangles of some voxels, (P,) each, some at a time; ``box`` (N, 4)
    has the first and last column and row of each."""
    u0, u1, v0, v1 = box[voxels].T.astype(np.intp)
    widths = u1 - u0 + 1
    counts = widths * (v1 - v0 + 1)
    ends = np.cumsum(counts)
    start = 0
    while start < voxels.size:
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + _PAIRS_AT_ONCE, side="right")))
        part = slice(start, stop)
        owner = np.repeat(np.arange(start, stop), counts[part])
        offset = np.arange(done, ends[stop - 1]) - (ends - counts)[owner]
        row, column = np.divmod(offset, widths[owner])
        yield voxels[owner], (v0[owner] + row) * width + u0[owner] + column
        start = stop


def _image(
    words: NDArray[np.uint64],
    relative: NDArray[np.float32],
    directions: NDArray[np.float32],
    camera: PinholeCamera,
) -> VoxelImage:
    """Unpack the words and find the face that each ray enters."""
    depth = _depth(words)
    met = np.isfinite(depth)
    index = np.where(met, (words & np.uint64(0xFFFFFFFF)).astype(np.int64), -1)
    offset = depth[met, None] * directions[met] - relative[index[met]]
    axis = np.argmax(np.abs(offset), axis=1)
    normal = np.zeros((depth.size, 3), np.float32)
    normal[np.flatnonzero(met), axis] = np.sign(offset[np.arange(axis.size), axis])
    return VoxelImage(
        depth_m=np.where(met, depth, np.float32(np.nan)).reshape(camera.shape),
        index=index.reshape(camera.shape),
        normal=normal.reshape(*camera.shape, 3),
    )


_NEAR_M = 0.01
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


_AMBIENT = 0.62
"""Brightness of a face that the light does not reach, relative to one that it meets squarely."""

_OCCLUSION = 0.55
"""How much of the light a deep hollow loses."""


def shaded(
    image: VoxelImage,
    colors: NDArray[np.uint8],
    normals: NDArray[np.floating],
    towards_light: NDArray[np.floating],
    background: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Colours of the voxels (N, 3) under a far light, on a background (H, W, 3), RGB.

    ``normals`` (N, 3) are the mean ones of the surfaces that the voxels belong to, 0 where unknown:
    mixed with the normal of the voxel's face they show both the surface and the grid.
    ``towards_light`` is a unit vector in the world frame.
    """
    hit = image.index >= 0
    voxel = image.index[hit]
    if voxel.size == 0:
        return background
    normal = image.normal[hit] + normals[voxel]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normal @ towards_light, 0.0, 1.0)
    light *= 1.0 - _OCCLUSION * _hollowness(image.depth_m)[hit]
    picture = background.copy()
    picture[hit] = np.rint(colors[voxel] * light[:, None])
    return picture


def shaded_triangles(
    image: TriangleImage,
    triangles: NDArray[np.integer],
    colors: NDArray[np.uint8],
    normals: NDArray[np.floating],
    towards_light: NDArray[np.floating],
    background: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Colours and ``normals`` of vertices (V, 3) on their triangles (T, 3) under a far light, on a background
    (H, W, 3), RGB."""
    hit = image.index >= 0
    if not hit.any():
        return background
    corners, shares = triangles[image.index[hit]], image.shares[hit]
    mixed = _mixed(shares, colors[corners])
    normal = _mixed(shares, normals[corners])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normal @ towards_light.astype(np.float32), 0.0, 1.0)
    picture = background.copy()
    picture[hit] = np.rint(mixed * (light * (1.0 - _OCCLUSION * _hollowness(image.depth_m)[hit]))[:, None])
    return picture


def _mixed(shares: NDArray[np.float32], of_corners: NDArray[Any]) -> NDArray[np.float32]:
    """Values of three corners, (n, 3, 3), mixed by their shares (n, 3)."""
    return np.einsum("nk,nkc->nc", shares, of_corners.astype(np.float32))


def _hollowness(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far each pixel lies behind its surroundings, (H, W), 0 to 1: a cheap ambient occlusion.

    The depth buffer's unsharp mask (Luft, Colditz and Deussen, SIGGRAPH 2006) at two scales.
    """
    met = np.isfinite(depth_m)
    near, far = np.quantile(depth_m[met], [0.01, 0.99])
    depth = np.where(met, depth_m, far).astype(np.float32)
    full = max(0.04 * float(far - near), 1e-6)
    out = np.zeros_like(depth)
    size = depth.shape[1], depth.shape[0]
    small = cv2.resize(depth, (-(-size[0] // 4), -(-size[1] // 4)), interpolation=cv2.INTER_AREA)
    for share_of_width in (0.004, 0.016):
        blurred = cv2.resize(cv2.GaussianBlur(small, (0, 0), share_of_width * small.shape[1]), size)
        out += 0.5 * np.clip((depth - blurred) / full, 0.0, 1.0)
    return out
