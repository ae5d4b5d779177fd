"""Level and upright cuts through a map, as images."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.up import Z_UP, plan_axes
from taichi_mrf.queries.box import FARTHEST_VOXEL, map_extent, voxel_box, voxels_of_box
from taichi_mrf.queries.voxel_map import VoxelMap

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class MapSlice:
    """One layer of voxels as an image whose first row is the lowest (``origin="lower"`` of imshow).

    ``occupancy`` (rows, columns) float32 and ``state`` (rows, columns) int8; ``extent`` is (left, right,
    bottom, top) in metres, along the world's axes ``across`` and ``up`` (bottom > top if that axis points
    down); ``at_m`` is where the layer's middle lies along the world's axis ``axis``.
    """

    occupancy: NDArray[np.float32]
    state: NDArray[np.int8]
    extent: tuple[float, float, float, float]
    across: Axis
    up: Axis
    axis: Axis
    at_m: float


def slice_map(
    m: VoxelMap,
    at: float,
    axis: Literal["up"] | Axis = "up",
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
) -> MapSlice:
    """The layer of voxels at ``at`` metres: at this height with "up", else at this place along the axis.

    Up is the map's ``up`` (z if it is unknown). The layer shows the
    whole map, or the part between ``lower`` and ``upper``, (2,) in metres along the image's two axes. A level
    layer is seen from above; in an upright one, up is up. Raises ConfigError for another axis, for corners
    that make no box and for an empty map, CapacityError if the layer does not fit memory.
    """
    if axis not in ("up", *get_args(Axis)):
        raise ConfigError(f"axis must be up, x, y or z, not {axis!r}")
    if not np.isfinite(at):
        raise ConfigError(f"a slice needs a finite place along {axis}, not {at}")
    up_axis, sign = m.up or Z_UP
    number = up_axis if axis == "up" else "xyz".index(axis)
    place_m = sign * at if axis == "up" else at
    if number == up_axis:
        across, upwards = plan_axes((up_axis, sign))
        flipped = False
    else:
        across, upwards = 3 - number - up_axis, up_axis
        flipped = sign < 0
    low, high = np.zeros(3), np.full(3, m.voxel_size)
    if lower is None or upper is None:
        whole = map_extent(m)
        low[[across, upwards]], high[[across, upwards]] = (ends[[across, upwards]] for ends in whole)
    for given, corner in ((lower, low), (upper, high)):
        if given is not None:
            values = np.asarray(given, np.float64)
            if values.shape != (2,):
                raise ConfigError(f"the corners of a slice are two numbers, not {values.shape}")
            corner[[across, upwards]] = values
    first, after = voxels_of_box(low, high, m.voxel_size)
    first[number] = np.floor(np.clip(place_m / m.voxel_size, -FARTHEST_VOXEL, FARTHEST_VOXEL))
    after[number] = first[number] + 1
    found = voxel_box(m, first, after)
    left_right = float(found.lower_m[across]), float(found.upper_m[across])
    bottom_top = float(found.lower_m[upwards]), float(found.upper_m[upwards])

    def image(values: NDArray) -> NDArray:
        rows_columns = values.transpose(upwards, across, number)[..., 0]
        return np.ascontiguousarray(rows_columns[::-1] if flipped else rows_columns)

    return MapSlice(
        image(found.occupancy),
        image(found.state),
        (*left_right, *(bottom_top[::-1] if flipped else bottom_top)),
        "xyz"[across],  # type: ignore[arg-type]
        "xyz"[upwards],  # type: ignore[arg-type]
        "xyz"[number],  # type: ignore[arg-type]
        float(found.centres(number)[0]),
    )
