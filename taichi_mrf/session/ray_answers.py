"""Answer to a click: what the ray of a pixel, or through a point in the map, meets."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.methods.map_file import StoredKeyframe
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.origins import starts_at
from taichi_mrf.viewer.messages import RayAnswer

BEHIND_SIGMAS = 3.0
"""A keyframe sees a point that lies at most this many sigma, or two voxels, behind its measurement."""


@dataclass(frozen=True)
class PixelNoise:
    """A measurement, its bias and its sigma, as ranges along the pixel's ray in metres."""

    measured_m: float
    bias_m: float
    sigma_m: float


def pixel_answer(m: OccupancyMap, image: StoredKeyframe, u: float, v: float) -> RayAnswer:
    """The ray of a pixel. Raises KeyframeError if the image has no such pixel."""
    along = image.camera.directions(u, v)
    if not _in_image(image.camera, u, v):
        raise KeyframeError(f"{image.name} has no pixel ({u:g}, {v:g})")
    return _answer(m, image, u, v, along)


def point_answer(
    m: OccupancyMap,
    point: Sequence[float],
    eye: Sequence[float],
    wanted: StoredKeyframe | None,
    others: Iterable[StoredKeyframe],
) -> RayAnswer:
    """The ray through a point: of the wanted keyframe if the point lies in its image, else of the first
    other one that sees it, else from the eye, where nothing was measured."""
    where = np.asarray(point, np.float64)
    if not (np.isfinite(where).all() and np.isfinite(eye).all()):
        raise KeyframeError("a point is not finite")
    if wanted is not None and (pixel := projected(wanted, where)) is not None:
        return _answer(m, wanted, pixel[0], pixel[1], wanted.camera.directions(pixel[0], pixel[1]))
    for image in others:
        pixel = projected(image, where)
        if pixel is not None and _sees(m, image, *pixel):
            return _answer(m, image, pixel[0], pixel[1], image.camera.directions(pixel[0], pixel[1]))
    start, along = np.asarray(eye, np.float64), where - np.asarray(eye, np.float64)
    # The viewpoint may be further away than the range of any sensor.
    reach = max(m.sensor.max_depth, 1.2 * float(np.linalg.norm(along)))
    return _profiled(m, "from where you look; no keyframe sees this point", start, along, None, reach)


def projected(image: StoredKeyframe, point: NDArray[np.float64]) -> tuple[float, float, float] | None:
    """(u, v, depth) of a world point in an image, None if no pixel sees it."""
    seen = image.camera.project((inverse(image.T_world_camera) @ np.append(point, 1.0))[None, :3])[0]
    return None if np.isnan(seen).any() else (float(seen[0]), float(seen[1]), float(seen[2]))


def _answer(
    m: OccupancyMap, image: StoredKeyframe, u: float, v: float, along: NDArray[np.float64]
) -> RayAnswer:
    column, row = _nearest(image.camera, u, v)
    depth, range_per_depth = float(image.depth_m[row, column]), float(np.linalg.norm(along))
    noise = None
    if depth > 0:
        sigma, bias = _noise_at(m, image, column, row, depth)
        noise = PixelNoise(depth * range_per_depth, bias * range_per_depth, sigma * range_per_depth)
    title = f"{image.name}, pixel ({column}, {row})"
    T = image.T_world_camera
    start, turned = T[:3, :3] @ starts_at(image.camera, u, v) + T[:3, 3], T[:3, :3] @ along
    answer = _profiled(m, title, start, turned, noise)
    return dataclasses.replace(answer, keyframe=image.id, pixel=(column, row))


def _profiled(
    m: OccupancyMap,
    title: str,
    start: NDArray[np.float64],
    along: NDArray[np.float64],
    noise: PixelNoise | None,
    max_range: float | None = None,
) -> RayAnswer:
    profile = m.ray_profile(start, along, max_range)
    unit = along / np.linalg.norm(along)
    return RayAnswer(
        title,
        (float(start[0]), float(start[1]), float(start[2])),
        (float(unit[0]), float(unit[1]), float(unit[2])),
        profile.distance,
        profile.length,
        profile.occupancy,
        profile.visibility,
        profile.omega,
        noise.measured_m if noise else None,
        noise.bias_m if noise else 0.0,
        noise.sigma_m if noise else 0.0,
    )


def _sees(m: OccupancyMap, image: StoredKeyframe, u: float, v: float, depth_m: float) -> bool:
    """True if the measurement at a pixel leaves the view free up to a depth."""
    column, row = _nearest(image.camera, u, v)
    measured = float(image.depth_m[row, column])
    if measured <= 0:
        return False
    sigma, _ = _noise_at(m, image, column, row, measured)
    return depth_m <= measured + max(BEHIND_SIGMAS * sigma, 2 * m.voxel_size)


def _nearest(camera: Camera, u: float, v: float) -> tuple[int, int]:
    """(column, row) of the pixel that holds (u, v)."""
    return min(max(round(u), 0), camera.width - 1), min(max(round(v), 0), camera.height - 1)


def _in_image(camera: Camera, u: float, v: float) -> bool:
    return -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5


def _noise_at(
    m: OccupancyMap, image: StoredKeyframe, column: int, row: int, depth_m: float
) -> tuple[float, float]:
    """Sigma and bias in metres of a pixel that measures a depth."""
    model = image.own.noise_model(m.noise, image.depth_m)
    # For whole images, which is all that a noise model of another package answers for.
    sigma, bias = model.table(image.camera).at_pixels(np.full(image.depth_m.shape, depth_m))
    return float(sigma[row, column]), float(bias[row, column])
