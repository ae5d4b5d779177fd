"""Pictures of what cameras without flat images see: a grid of azimuth and elevation around the sensor."""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.sensor.camera import Camera, forwards
from taichi_mrf.sensor.origins import ball_of, origins_of
from taichi_mrf.sensor.ray_table import RayTable

RAYS_PER_PIXEL = 3
"""Of rays without a pattern, so that few pixels of their picture stay empty."""

_LEAST_GAP = math.radians(20.0)
"""Azimuths that no ray has are left out if they are more than this together."""

_BINS = 360

ValueT = TypeVar("ValueT", bound=np.generic)


@dataclass(frozen=True)
class Unrolled:
    """A picture of a camera's image. ``camera`` has its pixels, with their origins if the image's camera
    moves; ``source`` (H, W) is the number, row by row, of the pixel of the image that each shows, -1 for
    none."""

    camera: Camera
    source: NDArray[np.intp]

    def image(self, values: NDArray[ValueT], nothing: float = 0.0) -> NDArray[ValueT]:
        """The picture of values (h, w) or (h, w, channels) of the image's pixels."""
        flat = values.reshape(-1, *values.shape[2:])
        shown = flat[self.source]
        shown[self.source < 0] = nothing
        return shown


def unrolled(camera: Camera) -> Unrolled:
    """The picture of a camera's images: the image itself if its pixels have a pattern, otherwise its rays on
    a grid (:func:`covering`)."""
    pixels = camera.width * camera.height
    if camera.pixels_per_radian > 0 or pixels == 1:
        return Unrolled(camera, np.arange(pixels).reshape(camera.shape))
    grid = _Grid.of(camera, max(1, pixels // RAYS_PER_PIXEL))
    shown = np.full(grid.rows * grid.columns, -1, np.intp)
    shown[grid.cells_of(camera.rays().reshape(-1, 3))] = np.arange(pixels)
    source, origins = shown.reshape(grid.rows, grid.columns), origins_of(camera)
    if origins is None:
        return Unrolled(grid.camera(), source)
    starts = np.where(source[..., None] >= 0, origins.reshape(-1, 3)[source], ball_of(camera)[0])
    return Unrolled(RayTable(grid.camera().rays(), starts), source)


def covering(camera: Camera, pixels: int) -> RayTable:
    """A camera with about so many square pixels that sees all that another sees, in the same frame. Its
    columns are azimuths around the other's upward direction, from left to right, its rows elevations from top
    to bottom."""
    return _Grid.of(camera, pixels).camera()


@dataclass(frozen=True)
class _Grid:
    """Cells of azimuth and elevation. ``axes`` (3, 3) are forwards, left and up in the camera frame, ``left``
    and ``top`` the angles of the picture's corner, ``step`` radians the side of a cell."""

    axes: NDArray[np.float64]
    left: float
    top: float
    step: float
    rows: int
    columns: int

    @staticmethod
    def of(camera: Camera, pixels: int) -> "_Grid":
        up = np.asarray(camera.up)
        ahead = forwards(camera)
        axes = np.stack([ahead, np.cross(up, ahead), up])
        azimuth, elevation = _angles(camera.rays().reshape(-1, 3), axes)
        left, width = _sector(azimuth)
        low, top = float(elevation.min()), float(elevation.max())
        area = max(width, 1e-3) * max(math.sin(top) - math.sin(low), 1e-3)
        step = math.sqrt(area / pixels)
        rows, columns = (max(1, math.ceil(size / step - 1e-6)) for size in (top - low, width))
        return _Grid(axes, left, top, step, rows, columns)

    def cells_of(self, rays: NDArray[np.float64]) -> NDArray[np.intp]:
        """The cell of each ray, (N,), row by row."""
        azimuth, elevation = _angles(rays, self.axes)
        column = np.floor((self.left - azimuth) % (2 * math.pi) / self.step).astype(np.intp)
        row = np.floor((self.top - elevation) / self.step).astype(np.intp)
        return np.clip(row, 0, self.rows - 1) * self.columns + np.clip(column, 0, self.columns - 1)

    def camera(self) -> RayTable:
        """The middles of the cells as rays."""
        e = (self.top - (np.arange(self.rows) + 0.5) * self.step)[:, None]
        a = (self.left - (np.arange(self.columns) + 0.5) * self.step)[None, :]
        level = np.cos(a)[..., None] * self.axes[0] + np.sin(a)[..., None] * self.axes[1]
        return RayTable(np.cos(e)[..., None] * level + np.sin(e)[..., None] * self.axes[2])


def _angles(
    rays: NDArray[np.float64], axes: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Azimuth and elevation of rays (N, 3), radians."""
    x, y, z = axes @ rays.T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def _sector(azimuth: NDArray[np.float64]) -> tuple[float, float]:
    """The leftmost azimuth and the width, radians, of the sector that holds all: the circle without its
    largest gap, if that is large."""
    used = np.unique(np.floor((azimuth + math.pi) / (2 * math.pi) * _BINS).astype(int) % _BINS)
    gaps = np.diff(used, append=used[0] + _BINS)
    largest = int(np.argmax(gaps))
    bin_rad = 2 * math.pi / _BINS
    if (gaps[largest] - 1) * bin_rad < _LEAST_GAP:
        return math.pi, 2 * math.pi
    width = (_BINS - gaps[largest] + 1) * bin_rad
    return float((used[largest] + 1) * bin_rad - math.pi), float(width)
