"""The first voxel that each pixel of a camera sees, exactly, from nothing but a list of voxels.

Independent of the map and its kernels, so pictures of any voxel list can be drawn, clipped or
filtered, on any machine. Each voxel is tested (slab test) against the pixels of its projected bounding
rectangle, near voxels first; a coarse depth pyramid drops those that are hidden (hierarchical
z-buffer, Greene, Kass and Miller 1993), so a map of millions of voxels takes seconds in NumPy.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
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
