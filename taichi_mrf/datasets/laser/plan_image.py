"""A floor plan as an image in the world's frame: where the walls are, for judging a map."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.images import read_grey
from taichi_mrf.errors import DatasetError

_DARK = 128
"""Grey values below this are wall."""


@dataclass(frozen=True)
class FloorPlan:
    """Walls on a grid of pixels."""

    wall: NDArray[np.bool_]
    """(H, W); the top row lies at the highest y, as in the image."""

    lower_x_y: tuple[float, float]
    """The image's lower left corner in metres, world frame."""

    pixel_x_y: tuple[float, float]
    """Width and height of a pixel in metres."""

    @property
    def upper_x_y(self) -> tuple[float, float]:
        """The image's upper right corner in metres."""
        height, width = self.wall.shape
        return (
            self.lower_x_y[0] + width * self.pixel_x_y[0],
            self.lower_x_y[1] + height * self.pixel_x_y[1],
        )

    def moved(self, x: float, y: float) -> "FloorPlan":
        """The plan, shifted by ``x`` and ``y`` metres."""
        return replace(self, lower_x_y=(self.lower_x_y[0] + x, self.lower_x_y[1] + y))

    def with_margin(self, pixels: int, *, wall: bool) -> "FloorPlan":
        """The plan with more pixels on every side, all of them wall or all of them open."""
        x, y = self.pixel_x_y
        return replace(
            self,
            wall=np.pad(self.wall, pixels, constant_values=wall),
            lower_x_y=(self.lower_x_y[0] - pixels * x, self.lower_x_y[1] - pixels * y),
        )

    def pixels(self, points: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row and column, each (...), of points (..., 2) in metres; they may lie outside the image."""
        column = np.floor((points[..., 0] - self.lower_x_y[0]) / self.pixel_x_y[0]).astype(np.intp)
        from_below = np.floor((points[..., 1] - self.lower_x_y[1]) / self.pixel_x_y[1]).astype(np.intp)
        return len(self.wall) - 1 - from_below, column

    def holds(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of the pixels lie in the image."""
        height, width = self.wall.shape
        return (row >= 0) & (row < height) & (column >= 0) & (column < width)


def read_floor_plan(path: str | Path, size_x_y: tuple[float, float]) -> FloorPlan:
    """Read an image of a floor plan, dark where there is a wall, of a given width and height in metres.

    It is centred on the world's origin, as Player/Stage places its bitmaps. Raises DatasetError.
    """
    if not all(math.isfinite(side) and side > 0 for side in size_x_y):
        raise DatasetError(f"{path}: the size of a floor plan must be two positive numbers, not {size_x_y}")
    image = read_grey(Path(path))
    height, width = image.shape
    return FloorPlan(
        wall=image < _DARK,
        lower_x_y=(-size_x_y[0] / 2, -size_x_y[1] / 2),
        pixel_x_y=(size_x_y[0] / width, size_x_y[1] / height),
    )
