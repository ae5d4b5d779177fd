"""Common parts of pictures of a whole map from outside: camera, light, background, colours of heights."""

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.figures import color_bar, new_figure
from taichi_mrf.sensor.camera import PinholeCamera

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PERSPECTIVE = PinholeCamera(width=1400, height=900, fx=1500.0, fy=1500.0, cx=699.5, cy=449.5)

OVERSAMPLING = 2
"""Pixels that are drawn for each of the picture, along each side: their mean has smooth edges."""

LIGHT = np.array([-0.45, -0.6, -0.66])
"""Towards the light, in the frame of the camera: from behind the viewer's left shoulder."""

HEIGHT_COLORS, HEIGHT_LABEL = "Spectral_r", "height above the lowest surface (m)"

_TOP, _BOTTOM = (52, 58, 68), (104, 112, 124)
"""The background at the top and at the bottom: neither white nor black things merge with it."""


def backdrop(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """The background of a picture (H, W, 3), RGB."""
    rows = np.linspace(_TOP, _BOTTOM, shape[0])
    return np.repeat(np.rint(rows).astype(np.uint8)[:, None], shape[1], axis=1)


def height_span(height_m: NDArray[np.floating], least_range_m: float) -> tuple[float, float]:
    """The lowest of heights (N,) in metres, and the range from there to the highest; stray ones do not
    count."""
    floor, top = np.quantile(height_m, [0.005, 0.995]) if height_m.size else (0.0, 0.0)
    return float(floor), max(float(top - floor), least_range_m)


def height_colors(height_m: NDArray[np.floating], least_range_m: float) -> tuple[NDArray[np.uint8], float]:
    """RGB (N, 3) of heights (N,), and the range in metres over which they are coloured."""
    from matplotlib import colormaps

    floor, range_m = height_span(height_m, least_range_m)
    return colormaps[HEIGHT_COLORS]((height_m - floor) / range_m, bytes=True)[:, :3], range_m


def overview(picture: NDArray[np.uint8], title: str, height_range_m: float | None) -> "Figure":
    """The figure of a picture drawn OVERSAMPLING times as large, with the scale of its heights, if any."""
    size = (PERSPECTIVE.width, PERSPECTIVE.height)
    figure = new_figure(13.0, 8.2)
    axes = figure.add_subplot()
    axes.imshow(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), interpolation="antialiased")
    axes.set_title(title)
    axes.axis("off")
    if height_range_m is not None:
        color_bar(axes, HEIGHT_COLORS, 0.0, height_range_m, HEIGHT_LABEL)
    return figure
