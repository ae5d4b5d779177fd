"""Boxes of space as arrays, with the probability and the state of every voxel, the extent of a map, and
slices of it as images.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.up import Z_UP, plan_axes
from taichi_mrf.queries.known_bricks import BrickReader, bricks_between, known_bricks
from taichi_mrf.queries.points import probability
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.tensors import on_host
from taichi_mrf.voxels.layout import BRICK

_BYTES_PER_VOXEL = 13
"""Log-odds as they are read, the same in the order of the box, the states, and what is made of them."""

FARTHEST_VOXEL = 2**22
"""A coordinate beyond any map's; places further away count as this far."""

_ON_A_FACE = 1e-6
"""In voxels: a corner so near to a face between voxels lies on it."""


@dataclass(frozen=True)
class BoxOfVoxels:
    """The voxels of an upright box. Index [i, j, k] is voxel ``lowest`` + (i, j, k) of the world.

    ``log_odds`` (nx, ny, nz) float32 of being occupied; ``state`` (nx, ny, nz) int8: UNKNOWN, FREE, OCCUPIED.
    """

    log_odds: NDArray[np.float32]
    state: NDArray[np.int8]
    lowest: tuple[int, int, int]
    voxel_size: float

    @cached_property
    def occupancy(self) -> NDArray[np.float32]:
        """Probability of being occupied, (nx, ny, nz)."""
        return probability(self.log_odds)

    @property
    def lower_m(self) -> NDArray[np.float64]:
        """Outer corner of the first voxel, (3,) in metres."""
        return np.array(self.lowest, np.float64) * self.voxel_size

    @property
    def upper_m(self) -> NDArray[np.float64]:
        """Outer corner of the last voxel, (3,) in metres."""
        return (np.array(self.lowest, np.float64) + self.state.shape) * self.voxel_size

    def centres(self, axis: int) -> NDArray[np.float64]:
        """Centres of the voxels along an axis, in metres."""
        return (
            self.lowest[axis] + np.arange(self.state.shape[axis], dtype=np.float64) + 0.5
        ) * self.voxel_size


def read_box(m: VoxelMap, lower: ArrayLike, upper: ArrayLike) -> BoxOfVoxels:
    """The voxels that overlap a box, from corner ``lower`` to corner ``upper``, (3,) in metres, as in the
    map's ``decided``.

    Raises ConfigError for corners that make no box, CapacityError if its voxels do not fit into memory.
    """
    return voxel_box(m.decided, *voxels_of_box(lower, upper, m.voxel_size))


def map_extent(m: VoxelMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two corners, (3,) in metres, of the box around all known space, rounded out to bricks of 8 voxels.
    Raises ConfigError for an empty map."""
    bricks = known_bricks(m)
    if not len(bricks):
        raise ConfigError("the map is empty: nothing was ever seen")
    brick_m = BRICK * m.voxel_size
    return bricks.min(axis=0) * brick_m, (bricks.max(axis=0) + 1) * brick_m


def voxels_of_box(
    lower: ArrayLike, upper: ArrayLike, voxel_size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The lowest voxel that a box in metres reaches into, and the one after the highest, (3,) each.

    Raises ConfigError for corners that make no box.
    """
    low, high = (
        np.asarray(on_host(corner, name), np.float64) for corner, name in ((lower, "lower"), (upper, "upper"))
    )
    if low.shape != (3,) or high.shape != (3,) or not np.isfinite([low, high]).all() or (low >= high).any():
        raise ConfigError("a box needs a lower and an upper corner of three finite numbers, lower < upper")
    first = np.floor(np.clip(low / voxel_size, -FARTHEST_VOXEL, FARTHEST_VOXEL) + _ON_A_FACE).astype(np.int64)
    after = np.ceil(np.clip(high / voxel_size, -FARTHEST_VOXEL, FARTHEST_VOXEL) - _ON_A_FACE).astype(np.int64)
    return first, np.maximum(after, first + 1)


def voxel_box(
    m: VoxelMap, first: NDArray[np.int64], after: NDArray[np.int64], reader: BrickReader | None = None
) -> BoxOfVoxels:
    """The voxels from ``first`` up to, but without, ``after``, (3,) voxel coordinates each, by the map's own
    log-odds. ``reader`` saves time where many boxes of the same map are read. Raises CapacityError.
    """
    lowest, highest = first // BRICK, (after - 1) // BRICK
    shape = highest - lowest + 1
    voxels = float(np.prod(shape.astype(np.float64))) * BRICK**3
    check_memory(_BYTES_PER_VOXEL * voxels, f"a box of {voxels / 1e6:.3g} million voxels")
    reader = BrickReader(m) if reader is None else reader
    values = reader.log_odds(bricks_between(lowest, highest))
    in_order = values.reshape(*shape, BRICK, BRICK, BRICK).transpose(0, 3, 1, 4, 2, 5)
    begin, end = first - lowest * BRICK, after - lowest * BRICK
    cut = tuple(slice(int(b), int(e)) for b, e in zip(begin, end, strict=True))
    log_odds = np.ascontiguousarray(in_order.reshape(shape * BRICK)[cut])
    x, y, z = first.tolist()
    return BoxOfVoxels(log_odds, reader.state(log_odds), (x, y, z), m.voxel_size)


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
    """The slice of voxels at ``at`` metres along ``axis``, where "up" is the map's up (z if unknown).

    It covers the whole map, or the part between ``lower`` and ``upper``, (2,) in metres along the image's two
    axes. A horizontal slice is seen from above; in a vertical one, up is up. Raises ConfigError for another
    axis, for corners that make no box and for an empty map, CapacityError if the slice does not fit memory.
    """
    if axis not in ("up", *get_args(Axis)):
        raise ConfigError(f"axis must be up, x, y or z, not {axis!r}")
    if not np.isfinite(at):
        raise ConfigError(f"at must be a finite position along {axis}, not {at}")
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
    found = voxel_box(m.decided, first, after)
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
