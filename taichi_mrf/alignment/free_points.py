"""Points with normals from rays without a pattern: planes fitted to the rays around, on a grid of angles."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.sensor.unrolled import unrolled

REACH = 2
"""Cells of the grid to each side whose rays count. A cell holds a ray of a few."""

Image = NDArray[np.float64]


def fit_free_planes(
    image: DepthImage, largest_jump: float, least_share: float
) -> tuple[Image, Image, Image, Image, Image, NDArray[np.bool_]]:
    """A plane for each cell of the grid of an image's rays (sensor/unrolled.py): its ray (H, W, 3) and where
    that starts (H, W, 3), its depth without bias and its sigma (H, W), the plane's normal towards the sensor
    (H, W, 3), and where one is.

    On the plane n . x = 1 the inverse depth of a ray with the direction d is n . d, or n . (d + o / depth)
    if the ray starts at o. The n of the least squares is that of all rays around whose depth differs by no
    more than the share ``largest_jump``; there must be ``least_share`` of all.
    """
    picture, measured = unrolled(image.camera), image.to_numpy().astype(np.float64)
    depth = picture.image(measured)
    rays = picture.image(image.camera.rays())
    origins = origins_of(image.camera)
    starts = np.zeros(rays.shape)
    if origins is not None:
        starts = picture.image(np.broadcast_to(origins, (*image.camera.shape, 3)))
    sigma, bias = (picture.image(of_pixel) for of_pixel in image.noise_table.at_pixels(measured))
    moments, sums, count = np.zeros((*depth.shape, 3, 3)), np.zeros(rays.shape), np.zeros(depth.shape)
    padded_depth = np.pad(depth, REACH)
    around = (REACH, REACH), (REACH, REACH), (0, 0)
    padded_rays, padded_starts = np.pad(rays, around), np.pad(starts, around)
    height, width = depth.shape
    for down, across in np.ndindex(2 * REACH + 1, 2 * REACH + 1):
        there = padded_depth[down : down + height, across : across + width]
        d = padded_rays[down : down + height, across : across + width]
        near = (there > 0) & (depth > 0) & (np.abs(there - depth) < largest_jump * depth)
        if origins is not None:
            shift = padded_starts[down : down + height, across : across + width] - starts
            d = d + shift / np.where(near, there, 1.0)[..., None]
        kept = np.where(near[..., None], d, 0.0)
        moments += kept[..., :, None] * kept[..., None, :]
        sums += kept / np.where(near, there, 1.0)[..., None]
        count += near
    found = count >= least_share * (2 * REACH + 1) ** 2
    # A window is a few degrees wide, so the smallest eigenvalue is about a thousandth of the largest.
    found &= np.linalg.det(moments) > 1e-12 * count**3
    normals = np.zeros(rays.shape)
    n = np.linalg.solve(moments[found], sums[found][..., None])[..., 0]
    normals[found] = -n / np.linalg.norm(n, axis=-1, keepdims=True)
    return rays, starts, depth - bias, sigma, normals, found
