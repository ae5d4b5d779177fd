"""Level and upright cuts through a map, as images."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import FARTHEST_VOXEL, map_extent, voxel_box, voxels_of_box
from taichi_mrf.queries.known_bricks import QueriedMap

Axis = Literal["x", "y", "z"]

_ACROSS_AND_UP = {"x": (1, 2), "y": (0, 2), "z": (0, 1)}
"""The axes of the world that run across and up in the image of a cut, by the axis that it is square to."""


@dataclass(frozen=True)
class MapSlice:
    """One layer of voxels as an image whose first row is the lowest (``origin="lower"`` of imshow).

    ``occupancy`` (rows, columns) float32 and ``state`` (rows, columns) int8; ``extent`` is (left, right,
    bottom, top) in metres, along the world's axes ``across`` and ``up``; ``at_m`` is where the layer's middle
    lies along the axis that is left.
    """

    occupancy: NDArray[np.float32]
    state: NDArray[np.int8]
    extent: tuple[float, float, float, float]
    across: Axis
    up: Axis
    at_m: float


def slice_map(
    m: QueriedMap, at: float, axis: Axis = "z", lower: ArrayLike | None = None, upper: ArrayLike | None = None
) -> MapSlice:
    """The layer of voxels at ``at`` metres along ``axis``: "z" cuts level, "x" and "y" upright.

    It shows the whole map, or the part between ``lower`` and ``upper``, (2,) in metres along the image's two
    axes. Raises ConfigError for another axis, for corners that make no box and for an empty map,
    CapacityError if the layer does not fit memory.
    """
    if axis not in _ACROSS_AND_UP:
        raise ConfigError(f"axis must be x, y or z, not {axis!r}")
    if not np.isfinite(at):
        raise ConfigError(f"a slice needs a finite place along {axis}, not {at}")
    across, up = _ACROSS_AND_UP[axis]
    number = "xyz".index(axis)
    low, high = np.zeros(3), np.full(3, m.voxel_size)
    if lower is None or upper is None:
        whole = map_extent(m)
        low[[across, up]], high[[across, up]] = whole[0][[across, up]], whole[1][[across, up]]
    for given, corner in ((lower, low), (upper, high)):
        if given is not None:
            values = np.asarray(given, np.float64)
            if values.shape != (2,):
                raise ConfigError(f"the corners of a slice are two numbers, not {values.shape}")
            corner[[across, up]] = values
    first, after = voxels_of_box(low, high, m.voxel_size)
    first[number] = np.floor(np.clip(at / m.voxel_size, -FARTHEST_VOXEL, FARTHEST_VOXEL))
    after[number] = first[number] + 1
    found = voxel_box(m, first, after)
    from_m, to_m = found.lower_m, found.upper_m
    return MapSlice(
        np.ascontiguousarray(found.occupancy.squeeze(number).T),
        np.ascontiguousarray(found.state.squeeze(number).T),
        (float(from_m[across]), float(to_m[across]), float(from_m[up]), float(to_m[up])),
        "xyz"[across],  # type: ignore[arg-type]
        "xyz"[up],  # type: ignore[arg-type]
        float(found.centres(number)[0]),
    )
