"""Cameras given by a table of each pixel's direction: arbitrary rays, and the base of spherical cameras."""

import copyreg
import hashlib
import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.origins import origins_of, turned
from taichi_mrf.sensor.stored import Arrays, Stored

if TYPE_CHECKING:
    from taichi_mrf.sensor.rays import TableRays


_CELLS = 64
"""Cells along each side of the cube around the unit sphere in which directions are counted."""

_MORTON_BITS = 10


def largest_turn(directions: NDArray[np.float64]) -> float:
    """The largest angle between neighbouring pixels of directions (H, W, 3) of any length, in radians."""
    units = _units(directions)
    chords = [np.linalg.norm(np.diff(units, axis=axis), axis=-1).max(initial=0.0) for axis in (0, 1)]
    return 2.0 * math.asin(min(1.0, 0.5 * max(chords)))


def cone_span(half_angle: float) -> int | None:
    """Largest number of cells along each side that a cone of ``half_angle`` radians can touch, for
    :func:`most_in_span`; None if it may touch all.

    The directions in a cone lie in a ball around its axis' end on the unit sphere, hence in a cube, and hence
    in the cells that the cube can touch.
    """
    if half_angle >= math.pi / 2:
        return None
    span = math.ceil(2.0 * math.sin(half_angle / 2) * _CELLS) + 1
    return span if span < _CELLS else None


def most_in_span(directions: NDArray[np.float64], span: int) -> int:
    """The most directions (H, W, 3) that lie in any cube of ``span`` cells a side. Nothing is kept: the sums
    are larger than the directions of a scan."""
    cells = _in_steps(_units(directions).reshape(-1, 3), _CELLS)
    flat = np.ravel_multi_index(tuple(cells.T), (_CELLS,) * 3)
    sums = np.bincount(flat, minlength=_CELLS**3).reshape((_CELLS,) * 3)
    for axis in range(3):
        # From the first cell on, with a zero before it; then differences over the span.
        sums = np.insert(sums.cumsum(axis=axis), 0, 0, axis=axis)
        index = (slice(None),) * axis
        sums = sums[(*index, slice(span, None))] - sums[(*index, slice(None, -span))]
    return int(sums.max())


def _units(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def morton_order(units: NDArray[np.float64]) -> NDArray[np.intp]:
    """The order (N,) of unit directions (N, 3) along a Morton curve through the cube around the sphere."""
    steps = _in_steps(units, 1 << _MORTON_BITS)
    key = np.zeros(len(units), np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            key |= (steps[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _in_steps(units: NDArray[np.float64], steps: int) -> NDArray[np.int64]:
    """Index of the step, of ``steps`` from -1 to 1, that each component lies in."""
    return np.clip(np.floor((units + 1.0) * (steps / 2)), 0, steps - 1).astype(np.int64)


_UNIT = 1e-5
"""Lengths that differ by no more from 1 count as 1."""

_SHORTEST = 1e-6
"""No direction is shorter than this."""


class RayTable(Stored):
    """A camera given by one ray for each pixel (camera.Camera). It is immutable, and equals every other table
    with the same rays.

    Depth is the parameter of a ray along its direction: range for directions of length 1, axial depth for
    those with z = 1. Directions between pixels are interpolated linearly, and normalised if all have the
    length 1. Rays without a pattern, such as those of a point cloud, are an image of one row, and each is
    cast alone, since neighbours in the row may be far from each other.

    A sensor that moves while it measures has ``origins_m``: where its rays start, in the frame of the image's
    pose. Directions are in that frame too (:meth:`moving`).
    """

    def __init__(self, directions: ArrayLike, origins_m: ArrayLike | None = None) -> None:
        """``directions`` are (H, W, 3), or (N, 3) for rays without a pattern, in the camera frame.
        ``origins_m``, in metres in the camera frame, are (W, 3) where the rays of a column start at one
        place, otherwise (H, W, 3), and (N, 3) for rays without a pattern; without them all rays start at the
        camera's centre, and origins that are all zero are left out. Both are kept as float32. Raises
        ConfigError for other shapes, for a value that is not finite, and for a direction without a length."""
        given = array(directions, "directions")
        if given.ndim not in (2, 3) or given.shape[-1] != 3 or given.size == 0:
            raise ConfigError(f"directions must be of shape (H, W, 3) or (N, 3), not {given.shape}")
        self.has_pattern: bool = given.ndim == 3
        """True if neighbours in the image are neighbours in space."""
        with np.errstate(over="ignore"):
            self._table = np.ascontiguousarray(given, np.float32).reshape((-1, *given.shape[-2:]))
        lengths = np.linalg.norm(self.rays(), axis=-1)
        wrong = ~(np.isfinite(lengths) & (lengths > _SHORTEST))
        if wrong.any():
            v, u = np.argwhere(wrong)[0]
            raise ConfigError(f"the direction of column {u}, row {v} is not finite or has no length")
        self.measures_range = bool((np.abs(lengths - 1.0) < _UNIT).all())
        """True if depth is range: all directions have the length 1."""
        self._table.flags.writeable = False
        self._origins = None if origins_m is None else self._checked_origins(origins_m)
        self._hulls: dict[int, NDArray[np.float64]] = {}
        self._most: dict[int, int] = {}

    def _checked_origins(self, origins_m: ArrayLike) -> NDArray[np.float32] | None:
        given = array(origins_m, "origins_m")
        shapes = ((self.width, 3), self._table.shape) if self.has_pattern else ((self.width, 3),)
        if given.shape not in shapes:
            expected = " or ".join(map(str, shapes))
            raise ConfigError(f"origins_m must be of shape {expected}, not {given.shape}")
        with np.errstate(over="ignore"):
            origins = np.array(given, np.float32).reshape(-1, self.width, 3)
        wrong = ~np.isfinite(origins).all(axis=-1)
        if wrong.any():
            v, u = np.argwhere(wrong)[0]
            raise ConfigError(f"the origin of column {u}, row {v} is not finite")
        origins.flags.writeable = False
        return origins if origins.any() else None

    @classmethod
    def moving(cls, camera: Camera, T_camera_column: ArrayLike) -> "RayTable":
        """The rays of a camera that moves while it measures. ``T_camera_column`` takes points of the frame in
        which the camera stood when it measured a column to that of the image's pose: (W, 4, 4), or
        (H, W, 4, 4) where the rows of a column are not measured together. Raises ConfigError for other shapes
        and for poses that are none."""
        poses = array(T_camera_column, "T_camera_column")
        height, width = camera.shape
        if poses.shape not in ((width, 4, 4), (height, width, 4, 4)):
            raise ConfigError(
                f"T_camera_column must be of shape {(width, 4, 4)} or {(height, width, 4, 4)}, "
                f"not {poses.shape}"
            )
        directions, origins = turned(poses, camera.rays(), origins_of(camera))
        if isinstance(camera, RayTable) and not camera.has_pattern:
            return RayTable(directions[0], origins.reshape(-1, 3))
        return RayTable(directions, origins.reshape(-1, 3) if origins.size == 3 * width else origins)

    @classmethod
    def of_points(
        cls, points_m: ArrayLike, T_camera_point: ArrayLike | None = None
    ) -> "tuple[RayTable, NDArray[np.float32]]":
        """The rays to the points (N, 3) of a cloud of unknown pattern, in metres from the sensor, and their
        ranges as an image (1, N). Rays near each other come one after the other; points that are not finite,
        or at the sensor, are left out. ``T_camera_point`` (N, 4, 4) are the poses at which a sensor that
        moves has measured them, in the frame of the image's pose. Raises ConfigError if no point is left, and
        for poses that are none."""
        points = array(points_m, "points_m")
        if points.ndim != 2 or points.shape[1] != 3:
            raise ConfigError(f"points_m must be of shape (N, 3), not {points.shape}")
        ranges = np.linalg.norm(points, axis=1)
        seen = np.isfinite(ranges) & (ranges > _SHORTEST)
        if not seen.any():
            raise ConfigError("no point of the cloud has a finite distance from the sensor")
        directions, ranges = points[seen] / ranges[seen, None], ranges[seen]
        origins = None
        if T_camera_point is not None:
            poses = array(T_camera_point, "T_camera_point")
            if poses.shape != (len(points), 4, 4):
                raise ConfigError(f"T_camera_point must be of shape {(len(points), 4, 4)}, not {poses.shape}")
            directions, origins = turned(poses[seen], directions)
        order = morton_order(directions)
        table = RayTable(directions[order], None if origins is None else origins[order])
        return table, ranges[order].astype(np.float32)[None]

    @property
    def width(self) -> int:
        """Columns of the image."""
        return self._table.shape[1]

    @property
    def height(self) -> int:
        """Rows of the image."""
        return self._table.shape[0]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width

    @property
    def table(self) -> NDArray[np.float32]:
        """The directions of all pixels as kernels read them, (H, W, 3), read-only."""
        return self._table

    @property
    def origins_m(self) -> NDArray[np.float32] | None:
        """Starting points of rays, (1, W, 3) if all rows share them, otherwise (H, W, 3), in metres in the
        camera frame, read-only; None if all start at the camera's centre."""
        return self._origins

    @cached_property
    def digest(self) -> str:
        """A text that distinguishes these rays from all others."""
        content = hashlib.blake2b(repr((self.shape, self.has_pattern)).encode(), digest_size=16)
        content.update(self._table.tobytes())
        if self._origins is not None:
            content.update(np.broadcast_to(self._origins, self._table.shape).tobytes())
        return content.hexdigest()

    def __repr__(self) -> str:
        pattern = "" if self.has_pattern else " without a pattern"
        moving = "" if self._origins is None else " of a moving sensor"
        return f"<{self.height} x {self.width} rays{pattern}{moving}, {self.digest}>"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RayTable) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def arrays(self) -> dict[str, NDArray[Any]]:
        name = "directions" if self.has_pattern else "free_directions"
        if self._origins is None:
            return {name: self._table}
        # Another name, so that versions without origins do not read the directions alone.
        return {f"moving_{name}": self._table, "origins_m": self._origins}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "RayTable":
        moving = "moving_" if "origins_m" in file else ""
        has_pattern = f"{moving}directions" in file
        name, height = (f"{moving}directions", None) if has_pattern else (f"{moving}free_directions", 1)
        directions = file.array(name, "f", (height, None, 3))
        origins_m = file.array("origins_m", "f", (height, None, 3)) if moving else None
        if origins_m is not None and len(origins_m) == 1:
            origins_m = origins_m[0]
        return RayTable(directions if has_pattern else directions[0], origins_m)

    def __reduce__(self) -> tuple[Any, ...]:
        if type(self) is not RayTable:  # its constructor may take other arguments
            return copyreg.__newobj__, (type(self),), self.__dict__  # type: ignore[attr-defined]
        directions = self._table if self.has_pattern else self._table[0]
        origins = self._origins
        return RayTable, (directions, origins if origins is None or len(origins) > 1 else origins[0])

    @property
    def up(self) -> tuple[float, float, float]:
        """Upwards in the camera frame of a level sensor: z of a lidar, -y of a camera with axial depth."""
        return (0.0, 0.0, 1.0) if self.measures_range else (0.0, -1.0, 0.0)

    @cached_property
    def pixels_per_radian(self) -> float:
        """Pixels along a metre at one metre of depth, which is a radian, where there are fewest; 0 for rays
        without a pattern, which are never taken together."""
        if not self.has_pattern or self._table.size == 3:
            return 0.0
        at_one_metre = self.rays() if self._origins is None else self._origins + self.rays()
        return 1.0 / max(_largest_step(at_one_metre), 1e-6)

    def rays(self) -> NDArray[np.float64]:
        """Directions of all pixels, (H, W, 3)."""
        return self._table.astype(np.float64)

    def directions(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """Rays through columns and rows that broadcast with each other, (..., 3); those outside the image are
        those of its edge."""
        between, exact = _interpolated(self._table, u, v)
        if self.measures_range:
            lengths = np.linalg.norm(between, axis=-1, keepdims=True)
            between = np.where(exact, between, between / np.maximum(lengths, _SHORTEST))
        return between

    def origins(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """Starting points of the rays through columns and rows, (..., 3) metres in the camera frame; the
        arguments are those of :meth:`directions`."""
        origins = np.zeros((1, self.width, 3), np.float32) if self._origins is None else self._origins
        return _interpolated(np.broadcast_to(origins, self._table.shape), u, v)[0]

    def project(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column, row and depth of the pixels whose rays pass nearest to points (N, 3) of the camera frame,
        (N, 3), NaN where even that ray passes further away than half a pixel's diagonal."""
        rays = self.rays().reshape(-1, 3)
        units = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        found = np.full(points_m.shape, np.nan)
        starts = None if self._origins is None else np.broadcast_to(self._origins, self._table.shape)
        for i, point in enumerate(points_m):
            if starts is None:
                along = units @ point
                pixel, range_m = int(np.argmax(along)), float(np.linalg.norm(point))
            else:
                way = point - starts.reshape(-1, 3)
                along, ranges = (units * way).sum(axis=1), np.linalg.norm(way, axis=1)
                pixel = int(np.argmax(along / np.maximum(ranges, _SHORTEST)))
                range_m = float(ranges[pixel])
            if along[pixel] > range_m * math.cos(self._pixel_radius):
                v, u = divmod(pixel, self.width)
                found[i] = u, v, along[pixel] / np.linalg.norm(rays[pixel])
        return found

    @cached_property
    def _pixel_radius(self) -> float:
        """Half the diagonal of the largest pixel, in radians; of rays without a pattern the whole one if they
        were spread evenly over the sphere."""
        if self.has_pattern and self._table.size > 3:
            return 0.75 * self._largest_turn
        return math.sqrt(4 * math.pi / (self._table.size / 3))

    def thinned(self, step: int) -> "RayTable":
        """The camera of every ``step``-th column and row."""
        thin, origins = self._table[::step, ::step], self._origins
        if origins is not None:
            origins = origins[::step, ::step] if len(origins) > 1 else origins[0, ::step]
        return RayTable(thin if self.has_pattern else thin[0], origins)

    def tile_hulls(self, tile: int) -> NDArray[np.float64]:
        """For each square of ``tile`` pixels, (rows, columns, 8, 3): the corners of the box around its
        directions and half a pixel more."""
        if not self.has_pattern:  # each scan has a table of its own, whose hulls are needed once
            return self._hulls_of(tile)
        if tile not in self._hulls:
            self._hulls[tile] = self._hulls_of(tile)
        return self._hulls[tile]

    def _hulls_of(self, tile: int) -> NDArray[np.float64]:
        rays = self.rays()
        margin = np.zeros(rays.shape)
        for axis in (0, 1) if self.has_pattern else ():
            if rays.shape[axis] > 1:
                half = 0.5 * np.abs(np.diff(rays, axis=axis))
                margin += np.concatenate([half, half.take([-1], axis=axis)], axis=axis)
        sides = np.stack(
            [_by_tile(np.minimum, rays - margin, tile), _by_tile(np.maximum, rays + margin, tile)]
        )
        corners = [[sides[c, ..., axis] for axis, c in enumerate(sign)] for sign in np.ndindex(2, 2, 2)]
        return np.moveaxis(np.array(corners), (0, 1), (2, 3))

    def most_pixels_in_cone(self, half_angle: float, block: int) -> float:
        """A bound on the pixels in a cone of ``half_angle`` radians, wherever it points, and in the square
        blocks of ``block`` pixels a side whose middle lies in it: all pixels of a cone wider by half a
        block's diagonal, counted."""
        if block > 1:
            half_angle += (block - 1) * self._largest_turn
        span = cone_span(half_angle)
        if span is None:
            return float(self.width * self.height)
        if span not in self._most:
            self._most[span] = most_in_span(self.rays(), span)
        return float(self._most[span])

    @cached_property
    def _largest_turn(self) -> float:
        return largest_turn(self.rays())

    @cached_property
    def _in_kernels(self) -> "TableRays":
        from taichi_mrf.sensor.rays import MovingTableRays, TableRays
        from taichi_mrf.system.resident import resident

        table = self.width, self.height, int(self.measures_range), resident(self._table.reshape(-1, 3))
        if self._origins is None:
            return TableRays(*table)
        return MovingTableRays(*table, resident(self._origins.reshape(-1, 3)), int(len(self._origins) > 1))

    def in_kernels(self) -> "TableRays":
        """The camera as kernels take it: a rays.TableRays."""
        return self._in_kernels


def _interpolated(
    table: NDArray[np.float32], u: ArrayLike, v: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Values of an (H, W, 3) table at columns and rows that broadcast with each other, (..., 3), linear
    between pixels, and which of these are pixels, (..., 1)."""
    height, width = table.shape[:2]
    columns, lines = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
    columns, lines = np.clip(columns, 0, width - 1), np.clip(lines, 0, height - 1)
    left, top = np.floor(columns).astype(np.intp), np.floor(lines).astype(np.intp)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    a, b = (columns - left)[..., None], (lines - top)[..., None]
    rows = [(1 - a) * table[row, left].astype(np.float64) + a * table[row, right] for row in (top, bottom)]
    return (1 - b) * rows[0] + b * rows[1], (a == 0) & (b == 0)


def _largest_step(rays: NDArray[np.float64]) -> float:
    """The largest distance between the directions of neighbouring pixels of (H, W, 3)."""
    steps = (np.linalg.norm(np.diff(rays, axis=axis), axis=-1) for axis in (0, 1))
    return max(float(step.max(initial=0.0)) for step in steps)


def _by_tile(best: np.ufunc, values: NDArray[np.float64], tile: int) -> NDArray[np.float64]:
    """The smallest or largest of (H, W, 3) values in each tile, (rows, columns, 3)."""
    rows, columns = (np.arange(0, size, tile) for size in values.shape[:2])
    return best.reduceat(best.reduceat(values, rows, axis=0), columns, axis=1)
