"""Points with normals from a depth image: planes fitted to small squares of pixels, on the backend."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.origins import origins_of, starts_at
from taichi_mrf.sensor.unrolled import unrolled
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, F32Array, F32Array2

STRIDE = 2
"""Pixels between points along both axes of the image."""

WINDOW = 0.016
"""Half the side of the square that a plane is fitted to, in radians: 8 pixels of a camera of 640 x 480. Half
of that leaves so much noise in the normals that poses of small images are wrong by centimetres."""

LEAST_WINDOW = 2
"""Least half side of that square, in pixels."""

MOST_STEPS = 4
"""A wider square than this many pixels to each side is looked at in wider steps."""

LARGEST_JUMP = 0.05
"""A neighbour whose depth differs by more than this share of a pixel's own lies on another surface."""

LEAST_SHARE = 0.6
"""A plane needs this share of the square's pixels."""

STEEPEST = 0.2
"""Cosine of the largest incidence (78 degrees) at which a measurement still locates a surface."""

REACH = 2
"""Cells of the grid to each side whose rays count. A cell holds a ray of a few."""

Image = NDArray[np.float64]


@dataclass(frozen=True)
class OrientedPoints:
    """Points of a depth image in its camera's frame, row by row.

    ``points`` (N, 3) float32 metres, freed of the sensor's bias; ``normals`` (N, 3) float32 unit vectors
    towards the camera; ``sigmas`` (N,) float32 metres, the sensor's noise along the normal. ``places`` (N, 2)
    int32 are the column and row of the grid of every STRIDE-th pixel.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    sigmas: NDArray[np.float32]
    places: NDArray[np.int32]

    def thinned(self, every: int) -> "OrientedPoints":
        """Those in every ``every``-th column and row."""
        return self.chosen((self.places % every == 0).all(axis=1))

    def chosen(self, rows: NDArray[np.bool_] | slice) -> "OrientedPoints":
        """Some of them."""
        return OrientedPoints(self.points[rows], self.normals[rows], self.sigmas[rows], self.places[rows])

    def about(self, number: int) -> "OrientedPoints":
        """About so many of them, evenly spread over the image."""
        return self.thinned(max(1, round(math.sqrt(len(self.points) / number))))


def oriented_points(image: DepthImage, max_depth: float) -> OrientedPoints:
    """The points of a depth image, up to ``max_depth`` metres, around which the surface is smooth. Their
    sigmas leave out that of the pose, which is what they are aligned for."""
    image, camera = image.at_certain_pose, image.camera
    if camera.pixels_per_radian == 0:
        return _of_free_rays(image, max_depth)
    columns, rows = -(-camera.width // STRIDE), -(-camera.height // STRIDE)
    half = max(LEAST_WINDOW, round(WINDOW * camera.pixels_per_radian))
    step = -(-half // MOST_STEPS)
    depth, sigmas = np.zeros((2, columns * rows), np.float32)
    normals = np.zeros((columns * rows, 3), np.float32)
    fit_planes(image.depth, image.sensor, step, half // step, columns, depth, normals, sigmas)
    runtime.settle()
    found = np.flatnonzero((depth > 0) & (depth <= max_depth))
    places = np.stack([found % columns, found // columns], axis=1).astype(np.int32)
    u, v = STRIDE * places.T
    points = camera.directions(u, v) * depth[found, None] + starts_at(camera, u, v)
    return OrientedPoints(points.astype(np.float32), normals[found], sigmas[found], places)


def _of_free_rays(image: DepthImage, max_depth: float) -> OrientedPoints:
    rays, starts, depth, sigmas, normals, found = fit_free_planes(image, LARGEST_JUMP, LEAST_SHARE)
    cosine = -(normals * rays).sum(axis=-1)
    found &= (depth > 0) & (depth <= max_depth) & (cosine > STEEPEST * np.linalg.norm(rays, axis=-1))
    v, u = np.nonzero(found)
    return OrientedPoints(
        (rays * depth[..., None] + starts)[found].astype(np.float32),
        normals[found].astype(np.float32),
        (cosine * sigmas)[found].astype(np.float32),
        np.stack([u, v], axis=1).astype(np.int32),
    )


@kernel
def fit_planes(
    measured: F32Array, sensor: Sensor, step: I32, steps: I32, columns: I32,
    depth: F32Array, normals: F32Array2, sigmas: F32Array,
) -> None:  # fmt: skip
    """A plane for every STRIDE-th pixel, from the pixels up to ``steps`` steps of ``step`` pixels away.

    ``measured`` is (H * W) metres, 0 without a measurement. The results are those of a grid with ``columns``:
    ``depth`` (N) metres without bias, 0 where there is no plane, ``normals`` (N, 3) unit vectors of the
    camera frame, ``sigmas`` (N) metres along the normal.

    The inverse depth of a plane is nearly linear in the pixel's place, for a pinhole exactly:
    1 / z = a du + b dv + c. The sensor makes the plane of these coefficients, which are those of the least
    squares over the pixels around.
    """
    for point in range(depth.shape[0]):
        width = sensor.camera.width
        u, v = point % columns * STRIDE, point // columns * STRIDE
        height = measured.shape[0] // width
        here = measured[v * width + u]
        depth[point] = 0.0
        sigmas[point] = 0.0
        for axis in ti.static(range(3)):
            normals[point, axis] = 0.0
        n, du, dv, q = 0.0, 0.0, 0.0, 0.0
        uu, uv, vv, uq, vq = 0.0, 0.0, 0.0, 0.0, 0.0
        if here > 0.0:
            for row in range(-steps, steps + 1):
                for column in range(-steps, steps + 1):
                    x, y = u + column * step, v + row * step
                    there = 0.0
                    if x >= 0 and y >= 0 and x < width and y < height:
                        there = measured[y * width + x]
                    if there > 0.0 and ti.abs(there - here) < LARGEST_JUMP * here:
                        i, j = ti.cast(x - u, ti.f32), ti.cast(y - v, ti.f32)
                        # From the pixel's own, so that no digits are lost.
                        inverse = 1.0 / there - 1.0 / here
                        n += 1.0
                        du += i
                        dv += j
                        q += inverse
                        uu += i * i
                        uv += i * j
                        vv += j * j
                        uq += i * inverse
                        vq += j * inverse
        if n >= LEAST_SHARE * (2 * steps + 1) ** 2:
            uu, uv, vv = uu - du * du / n, uv - du * dv / n, vv - dv * dv / n
            uq, vq = uq - du * q / n, vq - dv * q / n
            determinant = uu * vv - uv * uv
            a, b = (uq * vv - vq * uv) / determinant, (vq * uu - uq * uv) / determinant
            c = (q - a * du - b * dv) / n + 1.0 / here
            ray = sensor.direction(u, v)
            normal = -sensor.camera.plane(u, v, a, b, c).normalized()
            if -normal.dot(ray) > STEEPEST * ray.norm():
                noise = sensor.noise_at(u, v)
                depth[point] = sensor.surface_depth(here, noise)
                sigmas[point] = -normal.dot(ray) * noise.sigma(depth[point])
                for axis in ti.static(range(3)):
                    normals[point, axis] = normal[axis]


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
