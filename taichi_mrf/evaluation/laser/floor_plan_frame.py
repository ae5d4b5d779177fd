"""Pose of a floor plan in the frame of the scans, found by the share of the beams that end on its walls."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.plan_image import FloorPlan
from taichi_mrf.datasets.laser.scans import LaserScans

_SHORT_M = 2.0
"""Simulators make noise in proportion to the range, so only beams shorter than this locate walls."""

_EDGE_SHARE = 0.01
"""If a larger share of the beams end outside the image, its edge is a wall (with noise, half of the beams
that meet such a wall end outside)."""


@dataclass(frozen=True)
class Registration:
    """A plan that fits the scans, and how well it does."""

    plan: FloorPlan
    """The plan, shifted, and with a wall around it if ``walled_edge``."""

    shift_x_y: tuple[float, float]
    """By how much it was shifted, metres."""

    on_walls: float
    """Share of the short beams that end within a pixel of a wall."""

    on_walls_unshifted: float
    """That share for the plan as it was given."""

    walled_edge: bool
    """True if the plan's edge is a wall, as around the world of Player/Stage."""

    beyond_edge: float
    """Share of all beams that ended outside the plan's image, which decides this."""

    def text(self) -> str:
        """The findings as a sentence for a report."""
        x, y = self.shift_x_y
        edge = ", and its edge is a wall" if self.walled_edge else ""
        return (
            f"The floor plan lies at ({x:+.3f}, {y:+.3f}) m of where it was put{edge}: "
            f"{100 * self.on_walls:.1f}% of the short beams end within a pixel of a wall "
            f"({100 * self.on_walls_unshifted:.1f}% unshifted), "
            f"{100 * self.beyond_edge:.1f}% of all beyond its edge."
        )


def end_points(scans: LaserScans, longest_m: float = np.inf) -> NDArray[np.float64]:
    """End points of the beams that came back and are not longer, (P, 2) metres."""
    angle = scans.pose_x_y_theta[:, 2:] + scans.angle_rad
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    ends = scans.pose_x_y_theta[:, None, :2] + scans.range_m[..., None] * direction
    return ends[scans.hit & (scans.range_m > 0) & (scans.range_m <= longest_m)]


def register(plan: FloorPlan, scans: LaserScans, largest_shift_m: float = 0.3) -> Registration:
    """Shift a plan by whole pixels, up to so many metres either way, to where most short beams end on walls.

    Of equally good places the one nearest to where the plan was put wins. Then it is seen whether the edge is
    a wall, and if so the plan is shifted once more, with that wall.
    """
    short = end_points(scans, _SHORT_M)
    shift, shares = _best_shift(plan, short, largest_shift_m)
    ends = end_points(scans)
    beyond = float((~plan.moved(*shift).holds(*plan.moved(*shift).pixels(ends))).mean()) if len(ends) else 0.0
    walled = beyond > _EDGE_SHARE
    if walled:
        plan = plan.with_margin(1, wall=True)
        shift, shares = _best_shift(plan, short, largest_shift_m)
    middle = tuple(length // 2 for length in shares.shape)
    return Registration(plan.moved(*shift), shift, float(shares.max()), float(shares[middle]), walled, beyond)


def _best_shift(
    plan: FloorPlan, ends: NDArray[np.float64], largest_shift_m: float
) -> tuple[tuple[float, float], NDArray[np.float32]]:
    """The shift along x and y in metres, and the share that every shift gives."""
    shares = _share_by_shift(plan, ends, largest_shift_m)
    middle_row, middle_column = shares.shape[0] // 2, shares.shape[1] // 2
    rows, columns = np.nonzero(shares >= shares.max() - 1e-9)
    nearest = np.hypot(rows - middle_row, columns - middle_column).argmin()
    # Rows of an image go down, y goes up.
    x = float(columns[nearest] - middle_column) * plan.pixel_x_y[0]
    y = float(middle_row - rows[nearest]) * plan.pixel_x_y[1]
    return (x, y), shares


def _share_by_shift(
    plan: FloorPlan, ends: NDArray[np.float64], largest_shift_m: float
) -> NDArray[np.float32]:
    """Share of the points that lie within a pixel of a wall, for every shift of the plan by (row, column)
    pixels; no shift is in the middle."""
    margin_rows, margin_columns = (round(largest_shift_m / plan.pixel_x_y[axis]) for axis in (1, 0))
    # With a margin no shift loses points that lie at the edge.
    plan = plan.with_margin(max(margin_rows, margin_columns), wall=False)
    counts = np.zeros(plan.wall.shape, dtype=np.float32)
    rows, columns = plan.pixels(ends)
    inside = plan.holds(rows, columns)
    np.add.at(counts, (rows[inside], columns[inside]), 1.0)
    near = cv2.dilate(plan.wall.astype(np.float32), np.ones((3, 3), dtype=np.uint8))
    margins = ((margin_rows, margin_rows), (margin_columns, margin_columns))
    # Sliding the points over the padded walls gives every shift at once. Moving the plan by +1 moves the
    # points by -1 in its pixels.
    overlap = cv2.matchTemplate(np.pad(near, margins), counts, cv2.TM_CCORR)
    return np.asarray(overlap[::-1, ::-1] / max(len(ends), 1), dtype=np.float32)
