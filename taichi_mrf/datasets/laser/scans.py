"""Scans of a 2D laser scanner with known poses, what makes a scan unusable, and which range the scanner
reports for a beam without a return.

A scanner without a return reports its greatest range or an error code just below it: 81.91 and 81.83 m, 50 m,
32.77 m, ... Such beams pile up at one value, however far the robot moves; real surfaces do not.

A floor plan is an image in the world's frame that says where the walls are, for judging a map.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.images import read_grey
from taichi_mrf.errors import DatasetError
from taichi_mrf.factor_graph.beams import Beams

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
        return (self.lower_x_y[0] + width * self.pixel_x_y[0], self.lower_x_y[1] + height * self.pixel_x_y[1])

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
        """True for pixels that lie in the image."""
        height, width = self.wall.shape
        return (row >= 0) & (row < height) & (column >= 0) & (column < width)


def read_floor_plan(path: str | Path, size_x_y: tuple[float, float]) -> FloorPlan:
    """Read an image of a floor plan, dark where there is a wall, of a given width and height in metres. It is
    centred on the world's origin, as Player/Stage places its bitmaps. Raises DatasetError."""
    if not all(math.isfinite(side) and side > 0 for side in size_x_y):
        raise DatasetError(f"{path}: the size of a floor plan must be two positive numbers, not {size_x_y}")
    image = read_grey(Path(path))
    height, width = image.shape
    return FloorPlan(
        wall=image < _DARK,
        lower_x_y=(-size_x_y[0] / 2, -size_x_y[1] / 2),
        pixel_x_y=(size_x_y[0] / width, size_x_y[1] / height),
    )


DEFAULT_M = 49.5
"""Without a peak in the scans, ranges from here on count as no return: no wall indoors is as far away."""

TOLERANCE = 0.003
"""Ranges within this share of the largest one mean no return too: 81.83 to 81.91 m are error codes."""

_STEP_M = 0.01
_LONGEST_M = 1e4
_LEAST_BEAMS = 20
_TIMES_ITS_NEIGHBOURS = 10
_LEAST_MOTION_M = 1.0
_STRAY_SHARE = 0.01


def find_no_return_m(range_m: NDArray[np.floating], pose_x_y_theta: NDArray[np.floating]) -> float | None:
    """The least range (metres) that means no return, or None if no value stands out. ``range_m`` (N, B) are
    all scans, ``pose_x_y_theta`` (N, 3) the poses of the scanner. The value has at least 20 beams, ten times
    as many as any bin of 1 cm between half of it and itself, is reported from places at least 1 m apart, and
    hardly any range (1% of those beams) is larger."""
    steps = np.rint(np.minimum(range_m[range_m > 0], _LONGEST_M) / _STEP_M).astype(np.int64)
    count = np.bincount(steps)
    above = np.concatenate([np.cumsum(count[::-1])[::-1][1:], [0]])
    peaks = np.flatnonzero((count >= _LEAST_BEAMS) & (above <= _STRAY_SHARE * count))
    if len(peaks) == 0:
        return None
    peak = int(peaks[-1])
    first = int(np.floor(peak * (1 - TOLERANCE)))
    below = count[peak // 2 : first]
    if len(below) == 0 or count[peak] < _TIMES_ITS_NEIGHBOURS * below.max():
        return None
    limit_m = (first - 0.5) * _STEP_M
    places = pose_x_y_theta[(range_m >= limit_m).any(axis=1), :2]
    return float(limit_m) if np.ptp(places, axis=0).max() >= _LEAST_MOTION_M else None


@dataclass(frozen=True)
class LaserScans:
    """N scans of B beams each, in one world frame. A beam of scan i leaves ``pose_x_y_theta[i]``, the pose of
    the scanner, at the angle theta + ``angle_rad`` from the world's x axis, counter-clockwise. Ranges are
    positive; beams of range 0 are left out."""

    name: str

    range_m: NDArray[np.float32]
    """(N, B) measured range in metres; for a beam without a return, the scanner's greatest range."""

    angle_rad: NDArray[np.float64]
    """(B,) angles of the beams in the scanner's frame."""

    pose_x_y_theta: NDArray[np.float64]
    """(N, 3) metres, metres, radians."""

    hit: NDArray[np.bool_]
    """(N, B): False for beams without a return."""

    no_return_is_free: bool = True
    """True if a beam without a return is evidence that the space up to its range is free. In logs of real
    scanners most such beams met glass or something dark, and carry no evidence."""

    floor_plan: FloorPlan | None = None
    """The true floor plan, if it comes with the scans."""

    notes: tuple[str, ...] = ()
    """Sentences for the report: what was assumed or left out."""

    def __len__(self) -> int:
        return len(self.range_m)


def problem_of_scan(range_m: NDArray[np.floating], pose_x_y_theta: NDArray[np.floating]) -> str | None:
    """The problem with the values of one scan, (B,) and (3,), or None."""
    bad = ~np.isfinite(range_m) | (range_m < 0)
    if bad.any():
        beam = int(bad.argmax())
        return f"the range of beam {beam + 1} is {range_m[beam]:g}; ranges are finite and not negative"
    if not np.isfinite(pose_x_y_theta).all():
        return f"the pose contains a value that is not finite: {' '.join(f'{v:g}' for v in pose_x_y_theta)}"
    return None


def skipped_note(problems: list[str]) -> tuple[str, ...]:
    """The note on scans that were left out, with one error text each; empty without such scans."""
    if not problems:
        return ()
    return (f"{len(problems)} broken scans were left out; the first: {problems[0]}",)


def beams_of(scans: LaserScans, max_range_m: float = 0.0, no_return_is_free: bool | None = None) -> Beams:
    """All beams of all scans, in their order, in the plane z = 0 of the world frame. A beam longer than
    ``max_range_m`` (0: no limit) is cut there and then only marks its way as free. Beams of range 0 are left
    out, and so are those without a return, unless they mark their way as free: ``no_return_is_free``, or by
    default what the scans have."""
    count, beams = scans.range_m.shape
    angle = scans.pose_x_y_theta[:, 2:] + scans.angle_rad
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1).reshape(-1, 3)
    origin = np.column_stack([scans.pose_x_y_theta[:, :2], np.zeros(count)])
    range_m, hit = scans.range_m.ravel(), scans.hit.ravel()
    used = range_m > 0
    if not (scans.no_return_is_free if no_return_is_free is None else no_return_is_free):
        used &= hit
    if max_range_m > 0:
        hit = hit & (range_m <= max_range_m)
        range_m = np.minimum(range_m, np.float32(max_range_m))
    return Beams(
        origins=np.repeat(origin, beams, axis=0)[used],
        directions=directions[used],
        range_m=range_m[used],
        hit=hit[used],
    )
