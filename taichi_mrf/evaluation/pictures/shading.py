"""Light on a picture of voxels or triangles, so that its shape is legible and its colours still mean
something."""

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.triangle_raster import TriangleImage
from taichi_mrf.evaluation.pictures.voxel_raster import VoxelImage

_AMBIENT = 0.62
"""Brightness of a face that the light does not reach, relative to one that it meets squarely."""

_OCCLUSION = 0.55
"""How much of the light a deep hollow loses."""

BACKGROUND = 255
"""White."""


def shaded(
    image: VoxelImage,
    colors: NDArray[np.uint8],
    normals: NDArray[np.floating],
    towards_light: NDArray[np.floating],
) -> NDArray[np.uint8]:
    """Colours of the voxels (N, 3) under a far light, as an (H, W, 3) RGB picture on white.

    ``normals`` (N, 3) are the mean ones of the surfaces that the voxels belong to, 0 where unknown:
    mixed with the normal of the voxel's face they show both the surface and the grid.
    ``towards_light`` is a unit vector in the world frame.
    """
    hit = image.index >= 0
    voxel = image.index[hit]
    if voxel.size == 0:
        return np.full((*hit.shape, 3), BACKGROUND, np.uint8)
    normal = image.normal[hit] + normals[voxel]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normal @ towards_light, 0.0, 1.0)
    light *= 1.0 - _OCCLUSION * _hollowness(image.depth_m)[hit]
    picture = np.full((*hit.shape, 3), BACKGROUND, np.uint8)
    picture[hit] = np.rint(colors[voxel] * light[:, None])
    return picture


def shaded_triangles(
    image: TriangleImage,
    triangles: NDArray[np.integer],
    colors: NDArray[np.uint8],
    normals: NDArray[np.floating] | None,
    towards_light: NDArray[np.floating],
) -> NDArray[np.uint8]:
    """Colours of vertices (V, 3) on their triangles (T, 3), as an (H, W, 3) RGB picture on white; under a far
    light if the vertices' ``normals`` (V, 3) are given, else as they are."""
    hit = image.index >= 0
    picture = np.full((*hit.shape, 3), BACKGROUND, np.uint8)
    corners, shares = triangles[image.index[hit]], image.shares[hit]
    mixed = np.einsum("nk,nkc->nc", shares, colors[corners].astype(np.float64))
    if normals is not None and len(mixed):
        normal = np.einsum("nk,nkc->nc", shares, normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normal @ towards_light, 0.0, 1.0)
        mixed *= (light * (1.0 - _OCCLUSION * _hollowness(image.depth_m)[hit]))[:, None]
    picture[hit] = np.rint(mixed)
    return picture


def _hollowness(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far each pixel lies behind its surroundings, (H, W), 0 to 1: a cheap ambient occlusion.

    The depth buffer's unsharp mask (Luft, Colditz and Deussen, SIGGRAPH 2006) at two scales.
    """
    met = np.isfinite(depth_m)
    near, far = np.quantile(depth_m[met], [0.01, 0.99])
    depth = np.where(met, depth_m, far).astype(np.float32)
    full = max(0.04 * float(far - near), 1e-6)
    out = np.zeros_like(depth)
    for share_of_width in (0.004, 0.016):
        blurred = cv2.GaussianBlur(depth, (0, 0), share_of_width * depth.shape[1])
        out += 0.5 * np.clip((depth - blurred) / full, 0.0, 1.0)
    return out
