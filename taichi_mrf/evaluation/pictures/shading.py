"""Light on a picture of voxels or triangles, so that its shape is legible and its colours still mean
something."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.triangle_raster import TriangleImage
from taichi_mrf.evaluation.pictures.voxel_raster import VoxelImage

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
