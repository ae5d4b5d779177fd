"""Pictures from nothing but a list of voxels or of triangles: the first that each pixel of a camera sees,
exactly, and light on it, so that its shape is legible and its colours still mean something.

Independent of the map, so pictures of any voxel list can be drawn, clipped or filtered. Each shape is tested
against the pixels of its projected bounding rectangle: voxels by slabs, triangles, which are seen from the
side from which they run counter-clockwise, by edge functions (Pineda 1988). The nearest wins and, among
equals, the one that comes first.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import (
    F32,
    I32,
    F32Array,
    F32Array2,
    F32Array3,
    I32Array,
    I32Array2,
    Template,
    Vec3,
)
from taichi_mrf.voxels.traversal import FAR

_OVERLAP = 1e-5
"""Relative enlargement of the cubes: without it, rounding would let rays along a common face slip
between neighbours."""

_NEAR_M = 0.01
"""Triangles that reach nearer than this are left out."""

_NONE = np.iinfo(np.int32).max
"""In place of the number of a shape, and of the bits of a depth, where there is none."""


@kernel
def _draw(
    shapes: Template, boxes: I32Array2, width: I32, depth: I32Array, index: I32Array, numbering: I32
) -> None:
    """First the least ``depth`` (H * W) that a shape has at each pixel, as the bits of a float32, which sort
    like its value; then, with ``numbering``, the ``index`` (H * W) of the first shape that has it.

    ``boxes`` (N, 4) are the first and last column and row of each shape; ``shapes.depth_at(i, u, v, pixel)``
    is the axial depth at which a pixel's ray meets shape i, 0 where it does not.
    """
    for i in range(boxes.shape[0]):
        for v in range(boxes[i, 2], boxes[i, 3] + 1):
            for u in range(boxes[i, 0], boxes[i, 1] + 1):
                pixel = v * width + u
                met = shapes.depth_at(i, u, v, pixel)
                if met > 0.0:
                    bits = ti.bit_cast(met, ti.i32)
                    if numbering == 0:
                        ti.atomic_min(depth[pixel], bits)
                    elif depth[pixel] == bits:
                        ti.atomic_min(index[pixel], i)


def _drawn(
    shapes: "_Cubes | _Triangles", boxes: NDArray[np.int32], camera: PinholeCamera
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The depth at each pixel, (H * W), NaN where there is nothing, and the shape, -1 for none."""
    depth, index = np.full((2, camera.width * camera.height), _NONE, np.int32)
    if len(boxes):
        for numbering in (0, 1):
            _draw(shapes, boxes, camera.width, depth, index, numbering)
    depth_m, nothing = depth.view(np.float32), index == _NONE
    depth_m[nothing], index[nothing] = np.nan, -1
    return depth_m, index


@dataclass(frozen=True)
class VoxelImage:
    """Image of voxels, all (H, W, ...)."""

    depth_m: NDArray[np.float32]
    """Axial depth of the point where the ray enters the voxel, NaN where it meets none."""

    index: NDArray[np.int32]
    """Index of that voxel in the list, -1 where there is none."""

    normal: NDArray[np.float32]
    """Outward unit normal of the face that the ray enters, (H, W, 3), world frame, 0 where there is none."""


@dataclass(frozen=True)
class _Cubes(Bundle):
    """Axis-aligned cubes of the world frame."""

    relative: F32Array2
    """(N, 3): their centres, from the camera's."""

    inverse: F32Array2
    """(H * W, 3): 1 over the direction of each pixel's ray, whose depth is 1."""

    half: F32
    """Half of their side."""

    near_m: F32
    """Depth at which rays begin."""

    @ti.func
    def depth_at(self, i: I32, u: I32, v: I32, pixel: I32) -> F32:
        enter, leave = self.near_m, FAR
        for axis in ti.static(range(3)):
            middle = self.relative[i, axis] * self.inverse[pixel, axis]
            reach = self.half * ti.abs(self.inverse[pixel, axis])
            enter = ti.max(enter, middle - reach)
            leave = ti.min(leave, middle + reach)
        return enter if enter <= leave else 0.0


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
    relative = (np.asarray(centres, np.float64) - T_world_camera[:3, 3]).astype(np.float32)
    boxes = _boxes_of_cubes(relative, half, camera, T_world_camera, near_m)
    seen = np.flatnonzero(boxes[:, 1] >= 0)
    relative = relative[seen]
    # Directions with z = 1 in the camera frame, so that a ray's parameter is axial depth.
    directions = (camera.rays().reshape(-1, 3) @ T_world_camera[:3, :3].T).astype(np.float32)
    directions[np.abs(directions) < 1e-12] = 1e-12
    depth_m, index = _drawn(_Cubes(relative, 1.0 / directions, half, near_m), boxes[seen], camera)
    # The face that each ray enters is the one that it is farthest out along.
    met = index >= 0
    offset = depth_m[met, None] * directions[met] - relative[index[met]]
    axis = np.argmax(np.abs(offset), axis=1)
    normal = np.zeros((depth_m.size, 3), np.float32)
    normal[np.flatnonzero(met), axis] = np.sign(offset[np.arange(axis.size), axis])
    index[met] = seen[index[met]]
    shape = camera.shape
    return VoxelImage(depth_m.reshape(shape), index.reshape(shape), normal.reshape(*shape, 3))


def _boxes_of_cubes(
    relative: NDArray[np.float32], half: float, camera: PinholeCamera, T_world_camera: Pose, near_m: float
) -> NDArray[np.int32]:
    """The pixels that a cube may cover, as the first and last column and row (N, 4), -1 where the camera
    cannot see it; ``relative`` (N, 3) are the centres from the camera's."""
    rotation = T_world_camera[:3, :3].astype(np.float32)
    x, y, z = (relative @ rotation).T
    reach_x, reach_y, reach_z = half * np.abs(rotation).sum(axis=0)
    nearest, farthest = z - reach_z, z + reach_z
    visible = nearest > near_m
    near = np.where(visible, nearest, np.float32(1.0))
    far = np.where(visible, farthest, np.float32(1.0))
    boxes = np.empty((len(relative), 4), np.int32)
    for column, coordinate, reach, focal, centre, size in (
        (0, x, reach_x, camera.fx, camera.cx, camera.width),
        (2, y, reach_y, camera.fy, camera.cy, camera.height),
    ):
        low, high = coordinate - reach, coordinate + reach
        first = np.ceil(focal * np.minimum(low / near, low / far) + centre - 1e-3)
        last = np.floor(focal * np.maximum(high / near, high / far) + centre + 1e-3)
        visible &= (last >= 0) & (first <= size - 1) & (first <= last)
        boxes[:, column] = np.clip(first, 0, size - 1)
        boxes[:, column + 1] = np.clip(last, 0, size - 1)
    boxes[~visible] = -1
    return boxes


@dataclass(frozen=True)
class TriangleImage:
    """Image of triangles: ``depth_m`` (H, W) axial, NaN where there is nothing; ``index`` (H, W) of the
    triangle, -1 for none; ``shares`` (H, W, 3) of its three corners at the pixel."""

    depth_m: NDArray[np.float32]
    index: NDArray[np.int32]
    shares: NDArray[np.float32]


@dataclass(frozen=True)
class _Triangles(Bundle):
    """Triangles on the screen."""

    corners: F32Array3
    """(T, 3, 3): column and row of each corner, in pixels, and 1 over its depth, which is linear there."""

    @ti.func
    def depth_at(self, i: I32, u: I32, v: I32, pixel: I32) -> F32:
        away = ti.Matrix.zero(ti.f32, 3, 2)
        for corner in ti.static(range(3)):
            away[corner, 0] = self.corners[i, corner, 0] - u
            away[corner, 1] = self.corners[i, corner, 1] - v
        # Twice the areas opposite to the corners, negative inside: rows grow downwards.
        area, nearness, outermost = 0.0, 0.0, -FAR
        for corner in ti.static(range(3)):
            a, b = (corner + 1) % 3, (corner + 2) % 3
            opposite = away[a, 0] * away[b, 1] - away[a, 1] * away[b, 0]
            area += opposite
            nearness += opposite * self.corners[i, corner, 2]
            outermost = ti.max(outermost, opposite)
        return area / nearness if outermost <= 0.0 and area < 0.0 else 0.0


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
    points = np.stack([camera.fx * x / ahead + camera.cx, camera.fy * y / ahead + camera.cy, 1.0 / ahead], 1)
    corners = points.astype(np.float32)[triangles]
    first, last = np.ceil(corners[..., :2].min(axis=1)), np.floor(corners[..., :2].max(axis=1))
    size = np.array([camera.width, camera.height], np.float32)
    seen = (depth > _NEAR_M)[triangles].all(axis=1)
    seen &= (first <= last).all(axis=1) & (last >= 0).all(axis=1) & (first < size).all(axis=1)
    seen &= _twice_areas(corners) < 0
    bounds = np.clip(np.stack([first, last], axis=2), 0, size[:, None] - 1).astype(np.int32).reshape(-1, 4)
    bounds[~seen] = 0, -1, 0, -1
    depth_m, index = _drawn(_Triangles(corners), bounds, camera)
    shares = np.zeros((len(index), 3), np.float32)
    _share(corners, index, camera.width, shares)
    shape = camera.shape
    return TriangleImage(depth_m.reshape(shape), index.reshape(shape), shares.reshape(*shape, 3))


@kernel
def _share(corners: F32Array3, index: I32Array, width: I32, shares: F32Array2) -> None:
    """The ``shares`` (H * W, 3) of the corners of the triangle ``index`` (H * W) at each pixel; ``corners``
    are those of _Triangles."""
    for pixel in range(index.shape[0]):
        i = index[pixel]
        if i >= 0:
            away = ti.Matrix.zero(ti.f32, 3, 2)
            for corner in ti.static(range(3)):
                away[corner, 0] = corners[i, corner, 0] - pixel % width
                away[corner, 1] = corners[i, corner, 1] - pixel // width
            # Shares on the screen become shares in space: nearer corners count more.
            near = Vec3(0.0)
            for corner in ti.static(range(3)):
                a, b = (corner + 1) % 3, (corner + 2) % 3
                near[corner] = away[a, 0] * away[b, 1] - away[b, 0] * away[a, 1]
                near[corner] *= corners[i, corner, 2]
            for corner in ti.static(range(3)):
                shares[pixel, corner] = near[corner] / near.sum()


def _twice_areas(corners: NDArray[np.float32]) -> NDArray[np.float32]:
    """Twice the area of triangles (T, 3, 3) on the screen, negative where they run counter-clockwise."""
    (x, y), (u, v) = ((corners[:, k, :2] - corners[:, 0, :2]).T for k in (1, 2))
    return x * v - y * u


_AMBIENT = 0.62
"""Brightness of a face that the light does not reach, relative to one that it meets squarely."""

_OCCLUSION = 0.55
"""Share of the light that a deep hollow loses."""


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
    lit = background.reshape(-1, 3).astype(np.float32)
    if (image.index >= 0).any():
        _light(
            image.index.reshape(-1), image.shares.reshape(-1, 3), triangles.astype(np.int32),
            colors.astype(np.float32), normals.astype(np.float32),
            ti.Vector(towards_light.tolist(), ti.f32), _hollowness(image.depth_m).reshape(-1), lit,
        )  # fmt: skip
    return lit.astype(np.uint8).reshape(background.shape)


@kernel
def _light(
    index: I32Array, shares: F32Array2, triangles: I32Array2, colors: F32Array2, normals: F32Array2,
    towards_light: Vec3, hollowness: F32Array, lit: F32Array2,
) -> None:  # fmt: skip
    """The colours ``lit`` (H * W, 3), whole numbers, of the pixels in which there is a triangle."""
    for pixel in range(index.shape[0]):
        i = index[pixel]
        if i >= 0:
            color, normal = Vec3(0.0), Vec3(0.0)
            for corner in ti.static(range(3)):
                vertex, share = triangles[i, corner], shares[pixel, corner]
                color += share * Vec3(colors[vertex, 0], colors[vertex, 1], colors[vertex, 2])
                normal += share * Vec3(normals[vertex, 0], normals[vertex, 1], normals[vertex, 2])
            facing = normal.dot(towards_light) / ti.max(normal.norm(), 1e-6)
            light = _AMBIENT + (1.0 - _AMBIENT) * ti.max(0.0, ti.min(1.0, facing))
            light *= 1.0 - _OCCLUSION * hollowness[pixel]
            for channel in ti.static(range(3)):
                lit[pixel, channel] = ti.round(color[channel] * light)


def _hollowness(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth of each pixel behind its surroundings, (H, W), 0 to 1: a cheap ambient occlusion.

    The depth buffer's unsharp mask (Luft, Colditz and Deussen, SIGGRAPH 2006) at two scales.
    """
    met = np.isfinite(depth_m)
    near, far = np.quantile(depth_m[met], [0.01, 0.99]).astype(np.float32)
    depth = np.where(met, depth_m, far)
    full = max(0.04 * float(far - near), 1e-6)
    out = np.zeros_like(depth)
    size = depth.shape[1], depth.shape[0]
    small = cv2.resize(depth, (-(-size[0] // 4), -(-size[1] // 4)), interpolation=cv2.INTER_AREA)
    for share_of_width in (0.004, 0.016):
        blurred = cv2.resize(cv2.GaussianBlur(small, (0, 0), share_of_width * small.shape[1]), size)
        out += np.clip(np.subtract(depth, blurred, out=blurred), 0.0, full, out=blurred)
    out *= 0.5 / full
    return out
