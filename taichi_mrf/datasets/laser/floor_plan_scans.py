"""``synthetic:floor-plan``: laser scans of the simulated building, with its floor plan as the truth.

Options follow a question mark, ``synthetic:floor-plan?scans=200&beams=181&noise=0.02&seed=1``; the fields of
:class:`FloorPlanOptions` are the options.

The building has rooms, doors, pillars, and a path through all of it; everything lies in the plane. It is
centred on the world's origin, 14 m wide and 10 m deep: a corridor along x, three rooms to the north of it and
two to the south.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.values import check_field
from taichi_mrf.datasets.laser.scans import FloorPlan, LaserScans
from taichi_mrf.datasets.options import parse_options, require
from taichi_mrf.errors import DatasetError

DOOR_WIDTH = 1.0
WALL = 0.2
"""Thickness of every wall."""

HALF_WIDTH, HALF_DEPTH = 7.0, 5.0
"""Half of the building's outer size along x and y."""

HALF_CORRIDOR = 1.0
"""The corridor's walls stand this far from its middle, the line y = 0."""

NORTH_DOORS, SOUTH_DOORS = (-4.6, 0.0, 4.7), (-3.3, 3.7)
"""Middles of the doors along the corridor."""

NORTH_PARTITIONS, SOUTH_PARTITIONS = (-2.3, 2.4), (0.5,)
"""Middles of the walls between rooms."""

_PIXEL = 0.02


@dataclass(frozen=True)
class Building:
    """Solids of two kinds."""

    boxes: NDArray[np.float64]
    """(K, 4): lowest x, lowest y, highest x, highest y."""

    pillars: NDArray[np.float64]
    """(M, 3): x and y of the middle, radius."""

    def solid(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """True for points (..., 2) that lie in a solid."""
        inside = np.zeros(points.shape[:-1], dtype=bool)
        for x0, y0, x1, y1 in self.boxes:
            x, y = points[..., 0], points[..., 1]
            inside |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
        for x0, y0, radius in self.pillars:
            inside |= np.hypot(points[..., 0] - x0, points[..., 1] - y0) <= radius
        return inside

    def ranges(self, origin: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance, (B,), from a point (2,) to the first solid along each unit direction (B, 2); infinite
        where there is none."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # rays along an axis never arrive
            lower = (self.boxes[:, None, :2] - origin) / directions
            upper = (self.boxes[:, None, 2:] - origin) / directions
        # A ray along an edge of a box gives 0/0 there, and does not enter the box.
        enter = np.minimum(lower, upper).max(axis=-1)
        leave = np.maximum(lower, upper).min(axis=-1)
        boxes = np.where((enter <= leave) & (enter >= 0), enter, np.inf)
        middle = self.pillars[:, None, :2] - origin
        along = (middle * directions).sum(axis=-1)
        inside_root = along**2 - (middle**2).sum(axis=-1) + self.pillars[:, None, 2] ** 2
        near = along - np.sqrt(np.maximum(inside_root, 0.0))
        round_ones = np.where((inside_root >= 0) & (near >= 0), near, np.inf)
        return np.concatenate([boxes, round_ones]).min(axis=0)

    def plan(self) -> FloorPlan:
        """The building's floor plan; a pixel is wall if its middle lies in a solid."""
        width, height = round(2 * HALF_WIDTH / _PIXEL), round(2 * HALF_DEPTH / _PIXEL)
        x = -HALF_WIDTH + (np.arange(width) + 0.5) * _PIXEL
        y = HALF_DEPTH - (np.arange(height) + 0.5) * _PIXEL
        wall = self.solid(np.stack(np.meshgrid(x, y), axis=-1))
        return FloorPlan(wall, lower_x_y=(-HALF_WIDTH, -HALF_DEPTH), pixel_x_y=(_PIXEL, _PIXEL))


def building() -> Building:
    """The building: its walls with their doors, and what stands in the rooms."""
    inner_x, inner_y = HALF_WIDTH - WALL, HALF_DEPTH - WALL
    boxes = [
        (-HALF_WIDTH, -HALF_DEPTH, HALF_WIDTH, -inner_y),
        (-HALF_WIDTH, inner_y, HALF_WIDTH, HALF_DEPTH),
        (-HALF_WIDTH, -inner_y, -inner_x, inner_y),
        (inner_x, -inner_y, HALF_WIDTH, inner_y),
        *_wall_with_doors(HALF_CORRIDOR, NORTH_DOORS),
        *_wall_with_doors(-HALF_CORRIDOR - WALL, SOUTH_DOORS),
    ]
    half, edge = WALL / 2, HALF_CORRIDOR + WALL
    boxes += [(x - half, edge, x + half, inner_y) for x in NORTH_PARTITIONS]
    boxes += [(x - half, -inner_y, x + half, -edge) for x in SOUTH_PARTITIONS]
    furniture = [
        (-5.0, 2.8, -4.4, 3.4),
        (5.6, 4.2, 6.8, 4.8),
        (-5.2, -3.8, -3.6, -3.0),
        (1.0, -4.8, 1.8, -4.4),
    ]
    pillars = [(0.0, 3.1, 0.3), (4.6, 3.0, 0.25), (3.7, -3.0, 0.35)]
    return Building(np.array(boxes + furniture), np.array(pillars))


def robot_path() -> NDArray[np.float64]:
    """Corners, (P, 2), of the robot's path: through every door and around what stands in each room."""
    points = [(-6.2, 0.0)]
    for x, side, inner, outer, width in (
        (-4.6, 1, 2.0, 4.1, 1.2),
        (0.0, 1, 2.1, 4.1, 1.2),
        (4.7, 1, 2.0, 3.7, 1.1),
        (3.7, -1, 2.0, 4.0, 1.4),
        (-3.3, -1, 2.0, 4.3, 2.4),
    ):
        left, right = x - width, x + min(width, 1.4)
        room = [
            (x, 0.0),
            (x, inner),
            (left, inner),
            (left, outer),
            (right, outer),
            (right, inner),
            (x, inner),
        ]
        points += [(a, side * b) for a, b in room] + [(x, 0.0)]
    return np.array([*points, (-6.2, 0.0)])


def _wall_with_doors(y: float, doors: tuple[float, ...]) -> list[tuple[float, float, float, float]]:
    """Boxes of a wall along x, from y to y + WALL, that leave the doors open."""
    inner = HALF_WIDTH - WALL
    edges = [-inner, *(x + side * DOOR_WIDTH / 2 for x in doors for side in (-1, 1)), inner]
    return [(a, y, b, y + WALL) for a, b in zip(edges[::2], edges[1::2], strict=True)]


NAME = "synthetic:floor-plan"


@dataclass(frozen=True)
class FloorPlanOptions:
    """The options of the built-in scans."""

    scans: int = 200
    """Scans, evenly spread along the robot's path."""

    beams: int = 181
    """Beams of a scan, evenly spread over the field of view with both its ends."""

    field_of_view: float = 180.0
    """Angle between the first and the last beam, in degrees; the middle one looks ahead."""

    max_range: float = 8.0
    """Surfaces further away than this (metres) return nothing."""

    noise: float = 0.02
    """Standard deviation of the measured range in metres."""

    seed: int = 0
    """Starts the random numbers; a scan's noise depends on this and its index alone."""

    def __post_init__(self) -> None:
        require(self, scans=1, beams=1, seed=0)
        angle, reach_m, noise_m = self.field_of_view, self.max_range, self.noise
        check_field(0 < angle <= 360, "field_of_view", f"must be up to 360 degrees, not {angle}")
        positive = 0 < reach_m < math.inf
        check_field(positive, "max_range", f"must be a positive number of metres, not {reach_m}")
        check_field(0 <= noise_m < math.inf, "noise", f"must be a number of metres, not {noise_m}")


def open_floor_plan(source: str) -> LaserScans:
    """The scans of a source such as ``synthetic:floor-plan?scans=50``. Raises DatasetError."""
    name, _, query = source.partition("?")
    if name != NAME:
        raise DatasetError(f"{source}: no such source; the scans that are built in are {NAME}")
    return simulate_scans(parse_options(FloorPlanOptions, query, name))


def simulate_scans(options: FloorPlanOptions) -> LaserScans:
    """Drive through the building and cast every beam. The same options give the same scans."""
    walls = building()
    pose = poses_along(robot_path(), options.scans)
    half = math.radians(options.field_of_view) / 2
    angle = np.linspace(-half, half, options.beams) if options.beams > 1 else np.zeros(1)
    shape = (options.scans, options.beams)
    range_m, hit = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=bool)
    for scan in range(options.scans):
        heading = pose[scan, 2] + angle
        true = walls.ranges(pose[scan, :2], np.stack([np.cos(heading), np.sin(heading)], axis=-1))
        hit[scan] = true <= options.max_range
        noise = np.random.default_rng((options.seed, scan)).normal(0.0, options.noise, options.beams)
        # Without a lower end a beam could come out negative, which no scanner reports.
        measured = np.clip(np.where(hit[scan], true, 0.0) + noise, 0.01, options.max_range)
        range_m[scan] = np.where(hit[scan], measured, options.max_range)
    return LaserScans("floor-plan", range_m, angle, pose, hit, floor_plan=walls.plan())


def poses_along(corners: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Poses (count, 3), x y theta, evenly spread by length from the first corner (P, 2) to the last, each
    looking along its leg of the path."""
    legs = np.array([b - a for a, b in pairwise(corners)])
    lengths = np.hypot(*legs.T)
    ends = np.cumsum(lengths)
    at = np.linspace(0.0, ends[-1], count)
    leg = np.minimum(np.searchsorted(ends, at, side="right"), len(legs) - 1)
    along = (at - (ends - lengths)[leg])[:, None] * legs[leg] / lengths[leg, None]
    return np.column_stack([corners[leg] + along, np.arctan2(legs[leg, 1], legs[leg, 0])])
