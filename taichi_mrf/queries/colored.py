"""The colours of a map's voxels, for whoever draws or writes them.

A colour is four uint8: red, green, blue, and how much of the voxel cameras have seen, 255 for much and 0 for
nothing at all, in which case there is no colour.
"""

from typing import Protocol, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.queries.known_bricks import QueriedMap
from taichi_mrf.voxels.colors import NO_COLOR

_POINTS_AT_ONCE = 1 << 19


class ColoredMap(QueriedMap, Protocol):
    """A map whose voxels have colours."""

    @property
    def has_colors(self) -> bool:
        """Whether any voxel may have a colour."""
        ...

    def colors(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Colours at (N, 3) points in metres, (N, 4)."""
        ...

    def colors_in(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Colours of the voxels of some bricks of ``view.pool``, (n,) slots -> (n, 512, 4)."""
        ...


def is_colored(m: QueriedMap) -> TypeGuard[ColoredMap]:
    """Whether a map's voxels have colours."""
    return bool(getattr(m, "has_colors", False))


def shown_colors(m: ColoredMap, points: ArrayLike) -> NDArray[np.uint8]:
    """Colours (N, 3) of the voxels that hold the points (N, 3) in metres; NO_COLOR for those without one."""
    return painted(m.colors(points))


def shown_colors_in(m: ColoredMap, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
    """The same for the voxels of some bricks of ``view.pool``, (n,) slots -> (n, 512, 3)."""
    return painted(m.colors_in(slots))


def painted(found: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (..., 4) -> (..., 3); NO_COLOR for those without one."""
    return np.where(found[..., 3:] > 0, found[..., :3], np.uint8(NO_COLOR))


def blended_colors(m: ColoredMap, points: ArrayLike) -> NDArray[np.uint8]:
    """Colours (N, 3) at points (N, 3) in metres, blended from the voxels whose centres are the corners of the
    cube around each; a voxel counts by how near it is and by how much of it was seen."""
    places = np.asarray(points, np.float64)
    parts = [places[i : i + _POINTS_AT_ONCE] for i in range(0, len(places), _POINTS_AT_ONCE)]
    return np.concatenate([np.zeros((0, 3), np.uint8), *(_blended(m, part) for part in parts)])


def _blended(m: ColoredMap, points: NDArray[np.float64]) -> NDArray[np.uint8]:
    place = points / m.voxel_size - 0.5
    first = np.floor(place)
    share = place - first
    sums, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        found = m.colors((first + corner + 0.5) * m.voxel_size)
        near = np.where(np.array(corner, bool), share, 1.0 - share).prod(axis=1)
        weight = near * found[:, 3]
        sums += weight[:, None] * found[:, :3]
        weights += weight
    mean = np.rint(sums / np.maximum(weights, 1e-9)[:, None])
    return np.where(weights[:, None] > 0, mean, NO_COLOR).astype(np.uint8)
