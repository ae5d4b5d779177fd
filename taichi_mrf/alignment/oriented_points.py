"""Points with normals from a depth image: planes fitted to small squares of pixels, on the backend."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.free_points import fit_free_planes
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.kernels.bundles import kernel
from taichi_mrf.kernels.types import I32, F32Array, F32Array2
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.origins import starts_at
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti

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
        kept = (self.places % every == 0).all(axis=1)
        return OrientedPoints(self.points[kept], self.normals[kept], self.sigmas[kept], self.places[kept])

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
