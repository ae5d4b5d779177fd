"""How well a 2D map agrees with the true floor plan, cell by cell, within one cell."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.plan_image import FloorPlan
from taichi_mrf.evaluation.laser.laser_map import LaserMap

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
    """How many cells were judged: those that beams touch."""


def true_cells(plan: FloorPlan, laser_map: LaserMap, way_x_y: NDArray[np.float64]) -> NDArray[np.int8]:
    """State of each of the map's cells by the plan, (rows, columns): OCCUPIED if a pixel of wall lies in it,
    FREE if it is open and can be reached from the robot's way (P, 2), HIDDEN otherwise."""
    reached = _reachable(plan, way_x_y)
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


def _reachable(plan: FloorPlan, way_x_y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels without wall that hang together with one on the robot's way."""
    # Neighbours along the axes only: space does not leak through a wall's diagonal.
    _, region = cv2.connectedComponents((~plan.wall).astype(np.uint8), connectivity=4)
    row, column = plan.pixels(way_x_y)
    inside = plan.holds(row, column)
    visited = np.unique(region[row[inside], column[inside]])
    return np.asarray(np.isin(region, visited[visited > 0]))
