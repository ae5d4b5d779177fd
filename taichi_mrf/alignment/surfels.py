"""The surface that keyframes have measured, more finely than voxels: a point and a normal for each cell.

A voxel of 5 cm shows that a wall is in it, but not where in it, and the poses that are to be found are wrong
by less. So there are, for every voxel that a keyframe has measured something in, sums over its points there,
which are added up over keyframes as messages are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose

if TYPE_CHECKING:
    from taichi_mrf.alignment.oriented_points import OrientedPoints

_HALF = 1 << 20
"""Cells are numbered from minus this along each axis, three times 21 bits in one int64."""

ROUGHNESS = 0.2
"""Departure of a surface from a plane within a cell, and of cells from each other, in cell sizes."""

COHERENT = 0.8
"""Length of the mean of unit normals below which a cell holds an edge, or both sides of a sheet."""


@dataclass(frozen=True)
class Surfels:
    """Sums over points, cell by cell. ``keys`` (N,) int64, ascending, number the cells; ``sums`` (N, 7)
    float64 are the weights, the weighted points in metres in the world, and the weighted unit normals."""

    keys: NDArray[np.int64]
    sums: NDArray[np.float64]
    cell_size: float

    @property
    def cells(self) -> NDArray[np.int32]:
        """(N, 3) coordinates of the cells in the world, in cell sizes."""
        axes = [(self.keys >> shift) & (2 * _HALF - 1) for shift in (42, 21, 0)]
        return (np.stack(axes, axis=1) - _HALF).astype(np.int32)

    def within(self, lower_m: NDArray[np.float64], upper_m: NDArray[np.float64]) -> "Surfels":
        """Those in a box of metres in the world, but for parts of a cell."""
        first, last = np.floor(lower_m / self.cell_size), np.floor(upper_m / self.cell_size)
        cells = self.cells
        return self.chosen(np.asarray(((cells >= first) & (cells <= last)).all(axis=1)))

    def chosen(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Surfels":
        """Some of them: a mask (N,), or ascending numbers of rows."""
        return Surfels(self.keys[rows], self.sums[rows], self.cell_size)

    def coarser(self, factor: int) -> "Surfels":
        """The sums in cells ``factor`` times as wide."""
        if factor == 1:
            return self
        return _summed(_keys_of(self.cells // factor), self.sums, self.cell_size * factor)

    def planes(self) -> "Planes":
        """One plane for each cell that holds one."""
        weights = self.sums[:, 0]
        lengths = np.linalg.norm(self.sums[:, 4:], axis=1)
        flat = (weights > 0) & (lengths > COHERENT * weights)
        sums, weights, lengths = self.sums[flat], weights[flat], lengths[flat]
        return Planes(
            self.cells[flat], weights, sums[:, 1:4] / weights[:, None], sums[:, 4:] / lengths[:, None]
        )


@dataclass(frozen=True)
class Planes:
    """Cells (M, 3) int32 with the weight (M,), a point (M, 3) in metres in the world, and the unit normal
    (M, 3) of the surface in each."""

    cells: NDArray[np.int32]
    weights: NDArray[np.float64]
    points_m: NDArray[np.float64]
    normals: NDArray[np.float64]


def surfels_of(points: "OrientedPoints", T_world_camera: Pose, cell_size: float) -> Surfels:
    """The surfels of one keyframe. A point that the sensor is unsure of counts less."""
    rotation = T_world_camera[:3, :3].T
    world = points.points.astype(np.float64) @ rotation + T_world_camera[:3, 3]
    normals = points.normals.astype(np.float64) @ rotation
    weights = 1.0 / (1.0 + (points.sigmas.astype(np.float64) / (ROUGHNESS * cell_size)) ** 2)
    sums = np.concatenate([np.ones((len(world), 1)), world, normals], axis=1) * weights[:, None]
    return _summed(_keys_of(np.floor(world / cell_size).astype(np.int64)), sums, cell_size)


def merged(parts: Sequence[Surfels], cell_size: float) -> Surfels:
    """The surfels of several keyframes together."""
    keys = [np.zeros(0, np.int64), *(part.keys for part in parts)]
    sums = [np.zeros((0, 7)), *(part.sums for part in parts)]
    return _summed(np.concatenate(keys), np.concatenate(sums), cell_size)


def _keys_of(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    x, y, z = (np.clip(cells.astype(np.int64), -_HALF, _HALF - 1) + _HALF).T
    return (x << 42) | (y << 21) | z


def _summed(keys: NDArray[np.int64], sums: NDArray[np.float64], cell_size: float) -> Surfels:
    """Rows of equal key added up, in the order in which they came."""
    if len(keys) == 0:
        return Surfels(keys, sums, cell_size)
    order = np.argsort(keys, kind="stable")
    keys, sums = keys[order], sums[order]
    first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    return Surfels(keys[first], np.add.reduceat(sums, first, axis=0), cell_size)
