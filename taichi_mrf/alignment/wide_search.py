"""Correlative scan matching: the wide search for a sensor that sees around, metres and any turn away.

Floors and ceilings tell which way is up. Then every heading is tried at every place of a grid (Olson,
"Real-time correlative scan matching", 2009). A pose counts the points of the scan that fall into, or next to,
a cell with a surface whose normal is like theirs. From place to place the cells of all points differ by the
same step, so a pose costs one look into the grid for each point (Hess et al., "Real-time loop closure in 2D
LIDAR SLAM", 2016).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, I32Array

_SIDES = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.arange(8) * np.pi / 4] + [[0, 0, 1], [0, 0, -1]])
"""(10, 3) directions by which normals are sorted, with z up: eight headings, up and down. A cell has a bit
for each of its own, and another for each of those around it."""

SIDES = len(_SIDES)

_FOUND_BY = float(np.cos(np.radians(40.0)))
"""Cosine of the largest angle between a surface's normal and a direction by which it is found."""


@dataclass(frozen=True)
class Around:
    """Space of a wide search: up to ``reach_m`` from a (4, 4) pose, at the same height. ``up`` (3,) is
    upwards in the camera frame if it is held level. ``expected_m`` (3,) is where it should be by now, and
    ``spread_m`` the standard deviation of that."""

    T_world_camera: Pose
    up: tuple[float, float, float]
    reach_m: float
    expected_m: NDArray[np.float64]
    spread_m: float

    def box(self, points: OrientedPoints) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The corners, in metres in the world, of a box that holds a scan's points at any of its poses."""
        centre, farthest_m = self.T_world_camera[:3, 3], np.linalg.norm(points.points, axis=1).max()
        return centre - farthest_m - self.reach_m, centre + farthest_m + self.reach_m


@dataclass(frozen=True)
class CoarseGrid:
    """Grid of surfaces and the normals they have: ``cells`` (nx * ny * nz) int32 has the bits of _SIDES.
    ``lowest`` (3,) is the first cell in a level frame, ``shape`` (3,) how many there are."""

    cells: NDArray[np.int32]
    lowest: NDArray[np.int64]
    shape: NDArray[np.int64]

    @staticmethod
    def of(
        points_m: NDArray[np.float64],
        normals: NDArray[np.float64],
        lowest: NDArray[np.int64],
        shape: NDArray[np.int64],
        cell_m: float,
    ) -> "CoarseGrid":
        """The grid of some points (N, 3) and unit normals in a level frame."""
        places = np.floor(points_m / cell_m).astype(np.int64) - lowest
        inside = ((places >= 0) & (places < shape)).all(axis=1)
        alike = normals[inside] @ _SIDES.T
        found_by = (alike > _FOUND_BY) | (alike == alike.max(axis=1, keepdims=True))
        here = np.zeros(shape, np.int32)
        bits = (found_by << np.arange(SIDES)).sum(axis=1).astype(np.int32)
        np.bitwise_or.at(here, tuple(places[inside].T), bits)
        around = here
        for axis in range(3):
            padded = np.pad(around, [(1, 1) if axis == a else (0, 0) for a in range(3)])
            before, after = (padded.take(range(first, first + shape[axis]), axis) for first in (0, 2))
            around = around | before | after
        return CoarseGrid((here | around << SIDES).ravel(), lowest, shape)

    def numbers(self, cells: NDArray[np.int64]) -> NDArray[np.int32]:
        """The numbers (...) of cells (..., 3) of the level frame, all of them inside."""
        x, y, z = np.moveaxis(cells - self.lowest, -1, 0)
        return ((x * self.shape[1] + y) * self.shape[2] + z).astype(np.int32)


def candidates(points: OrientedPoints, surface: Planes, around: Around) -> list[Pose]:
    """The poses, (4, 4), at which a scan's ``points`` fit the ``surface`` best, the best one first, to about
    a cell and half a step of the heading. At least one."""
    T_last = around.T_world_camera
    up_world = upright(surface.normals, T_last[:3, :3] @ np.asarray(around.up))

    def steps_of(cell_m: float, R_level_world: NDArray[np.float64]) -> NDArray[np.int64]:
        reach = int(np.ceil(around.reach_m / cell_m))
        square = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, [0], indexing="ij"), -1)
        steps = square.reshape(-1, 3)
        return steps[np.hypot(steps[:, 0], steps[:, 1]) <= reach]

    return best_poses(points, surface, T_last, up_world, steps_of, RULES.candidates) or [T_last]


StepsOf = Callable[[float, NDArray[np.float64]], NDArray[np.int64]]
"""From the width of cells, metres, and the (3, 3) rotation of the world into the level frame, the steps
(places, 3) from the first place to all that are tried, in cells of the level frame."""


def best_poses(
    points: OrientedPoints,
    surface: Planes,
    T_first: Pose,
    up_world: NDArray[np.float64],
    steps_of: StepsOf,
    number: int,
) -> list[Pose]:
    """Up to ``number`` poses, (4, 4), at which a scan's ``points`` fit the ``surface`` best, the best one
    first: under every heading from each place that ``steps_of`` names around the pose ``T_first``, which is
    upright to 45 degrees. ``up_world`` (3,) is upwards in the world. None if no point is near enough."""
    # Level frames of the world and of the scan.
    up_camera = upright(points.normals.astype(np.float64), T_first[:3, :3].T @ up_world)
    R_level_world, R_level_camera = level_frame(up_world), level_frame(up_camera)
    ranges_m = np.linalg.norm(points.points, axis=1)
    wanted_m = np.median(ranges_m) / RULES.cells_to_median
    cell_m = float(np.clip(wanted_m, RULES.grid_finest_m, RULES.grid_widest_m))
    chosen = spread(points.points, cell_m)
    if len(chosen) == 0:
        return []
    level_points = points.points[chosen] @ R_level_camera.T
    level_normals = points.normals[chosen] @ R_level_camera.T
    # The cells of all points under each heading, and the steps from place to place.
    headings = np.linspace(0.0, 2 * np.pi, RULES.headings, endpoint=False, dtype=np.float64)
    turns = np.stack([turn_about_z(heading) for heading in headings])
    cells = np.floor(np.einsum("hab,nb->hna", turns, level_points) / cell_m).astype(np.int64)
    sides = np.argmax(np.einsum("hab,nb->hna", turns, level_normals) @ _SIDES.T, axis=-1)
    steps = steps_of(cell_m, R_level_world)
    lowest = cells.min(axis=(0, 1)) + steps.min(axis=0)
    shape = cells.max(axis=(0, 1)) + steps.max(axis=0) + 1 - lowest
    surface_m = (surface.points_m - T_first[:3, 3]) @ R_level_world.T
    grid = CoarseGrid.of(surface_m, surface.normals @ R_level_world.T, lowest, shape, cell_m)
    counts = scores(grid, cells, sides, steps)
    # The best poses that are apart from each other.
    found = []
    places_m = (steps * cell_m).astype(np.float64)
    for heading, place in peaks(counts, headings, places_m, RULES.candidates_apart * cell_m, number):
        T = np.eye(4)
        T[:3, :3] = R_level_world.T @ turns[heading] @ R_level_camera
        T[:3, 3] = T_first[:3, 3] + R_level_world.T @ (steps[place] * cell_m)
        found.append(T)
    return found


def upright(normals: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Upwards, (3,): the axis nearest to what is ``expected`` that most of the ``normals`` (N, 3), those of
    floors and ceilings, lie along; what is expected if there are none."""
    along = normals @ expected
    flat = normals * np.sign(along)[:, None]
    flat = flat[np.abs(along) > RULES.upright]
    if len(flat) == 0:
        return expected / np.linalg.norm(expected)
    some = flat[:: max(1, len(flat) // 300)]
    up = some[np.argmax((some @ some.T > RULES.level).sum(axis=1))]
    for _ in range(3):
        up = flat[flat @ up > RULES.level].mean(axis=0)
        up = up / np.linalg.norm(up)
    return up


def level_frame(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3): the rotation into a frame whose z points up."""
    side = np.eye(3)[np.argmin(np.abs(up))]
    x = side - up * (side @ up)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def turn_about_z(angle: float) -> NDArray[np.float64]:
    """(3, 3): a rotation by so many radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def spread(points_m: NDArray[np.float32], cell_m: float) -> NDArray[np.intp]:
    """Numbers of some points (N, 3), not too far away, none two in one cell."""
    near = np.flatnonzero(np.linalg.norm(points_m, axis=1) < RULES.farthest_cells * cell_m)
    _, first = np.unique(np.floor(points_m[near] / cell_m).astype(np.int64), axis=0, return_index=True)
    chosen = near[np.sort(first)]
    some = np.linspace(0, len(chosen) - 1, min(RULES.most_points, len(chosen))).round().astype(np.intp)
    return chosen[some]


def scores(
    grid: CoarseGrid, cells: NDArray[np.int64], sides: NDArray[np.intp], steps: NDArray[np.int64]
) -> NDArray[np.int32]:
    """(headings, places): what the scan scores under each heading, in which its points are in ``cells``
    (headings, N, 3) and their normals nearest to one of the ``sides`` (headings, N), after each of the
    ``steps`` (places, 3) in cells. A point scores 2 in a cell with its normal and 1 next to one."""
    counts = np.zeros(len(cells) * len(steps), np.int32)
    shifts = grid.numbers(steps + grid.lowest)
    bits = (1 << sides).astype(np.int32)
    count_matches(grid.cells, grid.numbers(cells).ravel(), bits.ravel(), shifts, cells.shape[1], counts)
    runtime.settle()
    return counts.reshape(len(cells), len(steps))


@kernel
def count_matches(
    grid: I32Array, cells: I32Array, bits: I32Array, shifts: I32Array, points: I32, counts: I32Array
) -> None:
    """``cells`` and ``bits`` (headings * points) are looked up in the ``grid`` after each of the ``shifts``
    (places); ``counts`` is (headings * places)."""
    for pose in range(counts.shape[0]):
        first, shift = pose // shifts.shape[0] * points, shifts[pose % shifts.shape[0]]
        count = 0
        for i in range(first, first + points):
            there, bit = grid[cells[i] + shift], bits[i]
            count += ti.min(there & bit, 1) + ti.min((there >> SIDES) & bit, 1)
        counts[pose] = count


def peaks(
    counts: NDArray[np.int32],
    headings: NDArray[np.float64],
    places_m: NDArray[np.float64],
    apart_m: float,
    number: int,
) -> list[tuple[int, int]]:
    """The numbers of the headings and places of the ``number`` highest counts that are apart from higher
    ones."""
    left, found = counts.copy(), []
    for _ in range(number):
        heading, place = (int(i) for i in np.unravel_index(np.argmax(left), left.shape))
        if left[heading, place] <= 0:
            break
        found.append((heading, place))
        turned = np.abs((headings - headings[heading] + np.pi) % (2 * np.pi) - np.pi) < RULES.apart_rad
        shifted = np.linalg.norm(places_m - places_m[place], axis=1) < apart_m
        left[np.ix_(turned, shifted)] = 0
    return found
