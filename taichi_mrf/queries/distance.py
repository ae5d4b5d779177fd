"""How far it is to the nearest occupied voxel, and which way leads away from it: what planners ask.

The distances are exact at the centres of voxels, from centre to centre (SciPy's Euclidean distance
transform), and linear between them along each axis, so that the gradient is that of what is returned. They
are cut off at a stated distance, which bounds the space that has to be looked at.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import voxel_box, voxels_of_box
from taichi_mrf.queries.known_bricks import QueriedMap
from taichi_mrf.queries.points import FREE, OCCUPIED, checked_points
from taichi_mrf.system.libraries import library
from taichi_mrf.system.memory import check_memory

_BYTES_PER_VOXEL = 40
"""What SciPy's transform takes at its peak."""

UnknownSpace = Literal["free", "occupied"]
"""Whether unknown voxels are obstacles."""


@dataclass(frozen=True)
class DistanceField:
    """Distances in a box: ``values`` (nx, ny, nz) float32 in metres at the centres of voxels, none larger
    than ``max_distance``; index [i, j, k] is voxel ``lowest`` + (i, j, k) of the world."""

    values: NDArray[np.float32]
    lowest: tuple[int, int, int]
    voxel_size: float
    max_distance: float

    def distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Metres to the nearest obstacle, (N, 3) -> (N,). Raises ConfigError for a point outside the box."""
        return self.distance_and_gradient(points)[0]

    def gradient(self, points: ArrayLike) -> NDArray[np.float64]:
        """The change of the distance per metre, (N, 3) -> (N, 3): it points away from the nearest obstacle,
        with a length of nearly 1, and is 0 where the distance is cut off. Raises ConfigError."""
        return self.distance_and_gradient(points)[1]

    def distance_and_gradient(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Both at once. Raises ConfigError for a point outside the box."""
        at = checked_points(points) / self.voxel_size - np.array(self.lowest) - 0.5
        last = np.array(self.values.shape) - 1
        if ((at < -0.5) | (at > last + 0.5)).any():
            raise ConfigError("a point lies outside the box of the distance field")
        at = np.clip(at, 0, last)
        first = np.minimum(np.floor(at).astype(np.int64), np.maximum(last - 1, 0))
        share = at - first
        distance, gradient = np.zeros(len(at)), np.zeros((len(at), 3))
        for corner in np.ndindex(2, 2, 2):
            up = np.array(corner)
            weights = np.where(up == 1, share, 1 - share)
            values = self.values[tuple(np.minimum(first + up, last).T)].astype(np.float64)
            distance += weights.prod(axis=1) * values
            for axis in range(3):
                others = np.delete(weights, axis, axis=1).prod(axis=1)
                gradient[:, axis] += (1 if up[axis] else -1) * others * values
        return distance, gradient / self.voxel_size


def distance_field(
    m: QueriedMap, lower: ArrayLike, upper: ArrayLike, max_distance: float, unknown: UnknownSpace = "free"
) -> DistanceField:
    """Distances everywhere in a box, (3,) corners in metres, to obstacles inside it and around it.

    ``unknown`` decides whether unknown voxels are obstacles. Raises ConfigError for corners that make no box
    and a distance that is not positive, CapacityError for a box that does not fit memory, TaichiMRFError
    without SciPy.
    """
    images = library("scipy.ndimage", "distances need", "mesh")
    if unknown not in ("free", "occupied"):
        raise ConfigError(f"unknown must be free or occupied, not {unknown!r}")
    if not (np.isfinite(max_distance) and max_distance > 0):
        raise ConfigError(f"max_distance must be a positive number, not {max_distance}")
    first, after = voxels_of_box(lower, upper, m.voxel_size)
    # A layer more: between the outermost centres and the box's own faces, too, the values must be right.
    first, after = first - 1, after + 1
    margin = int(np.ceil(max_distance / m.voxel_size))
    begin, end = first - margin, after + margin
    voxels = float(np.prod((end - begin).astype(np.float64)))
    check_memory(_BYTES_PER_VOXEL * voxels, f"distances in {voxels / 1e6:.3g} million voxels")
    state = voxel_box(m, begin, end).state
    obstacle = state == OCCUPIED if unknown == "free" else state != FREE
    inner = tuple(slice(margin, margin + n) for n in (after - first).tolist())
    if obstacle.any():
        distance = images.distance_transform_edt(~obstacle)[inner] * m.voxel_size
    else:
        distance = np.full(after - first, np.inf)
    values = np.minimum(distance, max_distance).astype(np.float32)
    x, y, z = first.tolist()
    return DistanceField(values, (x, y, z), m.voxel_size, max_distance)


def distances(
    m: QueriedMap, points: ArrayLike, max_distance: float, unknown: UnknownSpace = "free"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Metres to the nearest obstacle at points, (N, 3) -> (N,), and the gradient, (N, 3).

    Works out the field in the box around all points: for many queries of one place make a
    :func:`distance_field` once. Raises what that raises.
    """
    points_m = checked_points(points)
    if not len(points_m):
        return np.zeros(0), np.zeros((0, 3))
    middle = 0.5 * m.voxel_size
    lower, upper = points_m.min(axis=0) - middle, points_m.max(axis=0) + middle
    return distance_field(m, lower, upper, max_distance, unknown).distance_and_gradient(points_m)
