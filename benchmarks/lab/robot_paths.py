"""Straight paths of a round robot that trusts a map: how often it hits what the map has not shown.

A path is taken if every voxel of the map that the robot's ball passes through is FREE, as of the map's newest
keyframe. It is a collision if a surface of the true scene comes nearer to the path than the ball's radius
less PLAY_M, which allows for noise and the size of voxels.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.queries.points import FREE
from taichi_mrf.queries.voxel_map import VoxelMap

RADIUS_M = 0.2
PLAY_M = 0.05
LENGTH_M = 1.0

_STEP_M = 0.025
"""Between the points of a path at which its distance from surfaces is taken; the map is read at points this
far apart, or a voxel apart if voxels are smaller."""


@dataclass(frozen=True)
class Paths:
    """Paths of LENGTH_M metres: ``starts`` (n, 3) and ``directions`` (n, 3), of length one."""

    starts: NDArray[np.float64]
    directions: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.starts)

    @staticmethod
    def random(count: int, lower: ArrayLike, upper: ArrayLike, seed: Iterable[int]) -> "Paths":
        """Level paths that start and end in a box, (3,) corners in metres, evenly distributed."""
        draw = np.random.default_rng(list(seed))
        low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        starts, directions = np.zeros((0, 3)), np.zeros((0, 3))
        while len(starts) < count:
            begin = draw.uniform(low, high, (count, 3))
            angle = draw.uniform(0, 2 * math.pi, count)
            along = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
            end = begin + LENGTH_M * along
            kept = ((end >= low) & (end <= high)).all(axis=1)
            starts = np.concatenate([starts, begin[kept]])[:count]
            directions = np.concatenate([directions, along[kept]])[:count]
        return Paths(starts, directions)

    def clearance(self, scene: Scene) -> NDArray[np.float64]:
        """The least distance of each path's middle line from a surface, (n,) metres."""
        along = np.linspace(0.0, LENGTH_M, math.ceil(LENGTH_M / _STEP_M) + 1)
        points = self.starts[:, None] + along[:, None] * self.directions[:, None]
        return scene.signed_distance(points.reshape(-1, 3)).reshape(len(self), -1).min(axis=1)

    def trusted(self, m: VoxelMap) -> NDArray[np.bool_]:
        """Which paths the map shows as free throughout, (n,)."""
        taken = np.ones(len(self), np.bool_)
        ball = _around_a_path(min(_STEP_M, m.voxel_size))
        middle = ball[(ball[:, 1] == 0) & (ball[:, 2] == 0)]
        for local in (middle, ball):  # most paths are refused by their middle line alone
            left = np.flatnonzero(taken)
            points = self._world(local, left)
            taken[left] = (m.state(points.reshape(-1, 3)) == FREE).reshape(len(left), len(local)).all(axis=1)
        return taken

    def _world(self, local: NDArray[np.float64], which: NDArray[np.intp]) -> NDArray[np.float64]:
        """Points (p, 3) along, beside and above a path for some paths, (paths, p, 3)."""
        along = self.directions[which]
        beside = np.stack([-along[:, 1], along[:, 0], np.zeros(len(along))], axis=1)
        points = local[None, :, :1] * along[:, None] + local[None, :, 1:2] * beside[:, None]
        points[:, :, 2] += local[None, :, 2]
        return points + self.starts[which][:, None]


def _around_a_path(step_m: float) -> NDArray[np.float64]:
    """Points (p, 3) of all that the ball passes through: along, beside and above the start."""
    ends = np.arange(-RADIUS_M, LENGTH_M + RADIUS_M + 1e-9, step_m)
    across = np.arange(-math.floor(RADIUS_M / step_m), math.floor(RADIUS_M / step_m) + 1) * step_m
    points = np.stack(np.meshgrid(ends, across, across, indexing="ij"), axis=-1).reshape(-1, 3)
    over = np.maximum(np.maximum(-points[:, 0], points[:, 0] - LENGTH_M), 0.0)
    return points[over**2 + points[:, 1] ** 2 + points[:, 2] ** 2 <= RADIUS_M**2]


@dataclass
class Drives:
    """Outcome of some paths: how many the map trusted, how many of these were collisions, how many were
    truly free, with PLAY_M to spare, and how many of these the map refused."""

    taken: int = 0
    hit: int = 0
    free: int = 0
    refused: int = 0

    def add(self, trusted: NDArray[np.bool_], clearance_m: NDArray[np.float64]) -> None:
        """Count some paths, (n,) each."""
        free = clearance_m > RADIUS_M + PLAY_M
        self.taken += int(trusted.sum())
        self.hit += int((trusted & (clearance_m < RADIUS_M - PLAY_M)).sum())
        self.free += int(free.sum())
        self.refused += int((free & ~trusted).sum())
