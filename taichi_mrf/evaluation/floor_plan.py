"""Finished 2D maps against the true floor plan: the plan's pose in the frame of the scans, and the agreement
of cells.

Maps are arrays whose rows go from the lowest y up: the form that pictures, files and scores use. The pose is
found by the share of the beams that end on the plan's walls; cells agree within one cell.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.scans import FloorPlan, LaserScans


@dataclass(frozen=True)
class LaserMap:
    """States of the cells, (rows, columns); row 0 lies at the lowest y, column 0 at the lowest x."""

    occupied: NDArray[np.bool_]
    """The label of the cell."""

    seen: NDArray[np.bool_]
    """True if a beam touches the cell; the others are unknown."""

    marginals: NDArray[np.float32] | None
    """Probability of occupied, for the methods that give one."""

    cell_size: float
    """Metres."""

    lower_cell: tuple[int, int]
    """Integer coordinate along x and y of the first cell, which covers [coordinate, coordinate + 1) times
    the cell size."""

    @property
    def lower_x_y(self) -> tuple[float, float]:
        """The outer corner of the first cell in metres."""
        return self.lower_cell[0] * self.cell_size, self.lower_cell[1] * self.cell_size

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest x, lowest and highest y in metres, the order of matplotlib's imshow."""
        rows, columns = self.occupied.shape
        x, y = self.lower_x_y
        return x, x + columns * self.cell_size, y, y + rows * self.cell_size


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


HIDDEN, FREE, OCCUPIED = -1, 0, 1
"""True states of a cell; hidden is what the robot cannot get to, such as the inside of a solid."""


@dataclass(frozen=True)
class CellScores:
    """Agreement for one kind of cells; NaN where there is nothing to divide by."""

    precision: float
    """Share of the cells of this label that have such a cell of the plan within reach."""

    recall: float
    """Share of the plan's cells of this kind that have such a label within reach."""

    iou: float
    """Intersection over union: 1 / (1/precision + 1/recall - 1), which within 0 cells is the usual ratio."""


@dataclass(frozen=True)
class FloorPlanScores:
    """Both kinds of cells."""

    occupied: CellScores
    free: CellScores
    cells: int
    """Number of cells judged: those that beams touch."""


def true_cells(plan: FloorPlan, laser_map: LaserMap, path_x_y: NDArray[np.float64]) -> NDArray[np.int8]:
    """State of each of the map's cells by the plan, (rows, columns): OCCUPIED if a pixel of wall lies in it,
    FREE if it is open and can be reached from the robot's path (P, 2), HIDDEN otherwise."""
    reached = _reachable(plan, path_x_y)
    rows, columns = laser_map.occupied.shape
    size = laser_map.cell_size
    # So many samples along a side that none of the pixels that lie wholly in a cell is missed.
    samples = math.ceil(size / min(plan.pixel_x_y))
    x, y = (
        laser_map.lower_x_y[axis] + (np.arange(cells * samples) + 0.5) * size / samples
        for axis, cells in ((0, columns), (1, rows))
    )
    pixel_row, pixel_column = plan.pixels(np.stack(np.meshgrid(x, y), axis=-1))
    inside = plan.holds(pixel_row, pixel_column)
    wall, open_ = np.zeros(inside.shape, dtype=bool), np.zeros(inside.shape, dtype=bool)
    wall[inside] = plan.wall[pixel_row[inside], pixel_column[inside]]
    open_[inside] = reached[pixel_row[inside], pixel_column[inside]]

    def any_in_cell(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.asarray(mask.reshape(rows, samples, columns, samples).any(axis=(1, 3)))

    free = np.where(any_in_cell(open_), FREE, HIDDEN)
    return np.where(any_in_cell(wall), OCCUPIED, free).astype(np.int8)


def floor_plan_scores(laser_map: LaserMap, truth: NDArray[np.int8], within: int = 1) -> FloorPlanScores:
    """Judge the cells that beams touch against the truth, (rows, columns) as :func:`true_cells` gives it.

    A cell is right if one of the same kind lies at most ``within`` cells away, also diagonally. A cell that
    is hidden is no place to look for: calling it occupied is neither right nor wrong, calling it free is
    wrong (unless free space is within reach).
    """
    seen = laser_map.seen
    is_wall, is_open = truth == OCCUPIED, truth == FREE
    occupied, free = seen & laser_map.occupied, seen & ~laser_map.occupied
    judged = occupied & ((truth != HIDDEN) | _grown(is_wall, within))
    return FloorPlanScores(
        occupied=_scores(judged, seen & is_wall, is_wall, within),
        free=_scores(free, seen & is_open, is_open, within),
        cells=int(seen.sum()),
    )


def _scores(
    labelled: NDArray[np.bool_], wanted: NDArray[np.bool_], true: NDArray[np.bool_], within: int
) -> CellScores:
    """``wanted`` are the true cells that beams touch; a label may also be near one that none does."""
    precision = _share(labelled, _grown(true, within))
    recall = _share(wanted, _grown(labelled, within))
    if math.isnan(precision) or math.isnan(recall):
        return CellScores(precision, recall, 0.0 if labelled.any() or wanted.any() else math.nan)
    iou = 0.0 if 0.0 in (precision, recall) else 1 / (1 / precision + 1 / recall - 1)
    return CellScores(precision, recall, iou)


def _share(cells: NDArray[np.bool_], right: NDArray[np.bool_]) -> float:
    return float((cells & right).sum() / cells.sum()) if cells.any() else math.nan


def _grown(cells: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    kernel = np.ones((2 * by + 1, 2 * by + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), kernel) > 0)


def _reachable(plan: FloorPlan, path_x_y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels without wall that hang together with one on the robot's path."""
    # Neighbours along the axes only: space does not leak through a wall's diagonal.
    _, region = cv2.connectedComponents((~plan.wall).astype(np.uint8), connectivity=4)
    row, column = plan.pixels(path_x_y)
    inside = plan.holds(row, column)
    visited = np.unique(region[row[inside], column[inside]])
    return np.asarray(np.isin(region, visited[visited > 0]))
