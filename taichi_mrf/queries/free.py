"""Free space with a promise: of the voxels that are called free at a level p, at most 1 - p contain matter.

A voxel is free at a level if its state is free and the log-odds by which it has its state
(``VoxelMap.decided``) lie below the level's bound. Bounds come from frames that the map has not seen
(evaluation/free_space.py), or from a table. A ball, a box or a path is free if all voxels that it reaches
into are; the promise holds for each of these voxels.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import real
from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import voxels_of_box
from taichi_mrf.queries.points import FREE, checked_points, state_of
from taichi_mrf.queries.within import checked_paths, path_places
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, F32Array

LEVELS = (0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999)
"""Levels that have bounds of their own; between them bounds are interpolated."""

DEFAULT_LEVEL = 0.99

NEVER = -1e9
"""The bound of a level that cannot be promised."""

_AT_ONCE = 1 << 20
"""Voxels that are looked up together."""


@dataclass(frozen=True)
class FreePromise:
    """Bounds on the log-odds of voxels that are free at some levels, and how well they hold.

    Arrays have an entry for each of ``levels``, which ascend. A voxel is free at a level if its log-odds are
    below ``bound``, which is NEVER for a level that cannot be promised. ``held_least`` and ``held_most``: of
    what is called free, the share without a measured end, in the worst and the best held-out frame, each
    judged with the bounds of the others. ``lost_m``: how much of the last metre of a measured ray is free
    and not free at the level, in metres. ``blocks`` is the number of frames; 0 if the bounds are those of the
    default table.
    """

    levels: NDArray[np.float64]
    bound: NDArray[np.float64]
    held_least: NDArray[np.float64]
    held_most: NDArray[np.float64]
    lost_m: NDArray[np.float64]
    blocks: int

    def most_log_odds(self, level: float) -> float:
        """The bound of a level: linear in log(1 - level) between those of ``levels``; below the lowest that
        of the lowest. Raises ConfigError for a level that is not between 0 and 1, or that the frames behind
        the bounds cannot promise."""
        level = real(level, "level", above=0)
        if level >= 1:
            raise ConfigError(f"level must be less than 1, not {level:g}")
        can = self.bound > NEVER
        if not can.any() or level > self.levels[can].max() + 1e-9:
            most = f"{self.levels[can].max():g} at most" if can.any() else "no level"
            what = "frames that calibrated this map allow" if self.blocks else "default table allows"
            raise ConfigError(f"a level of {level:g} cannot be promised: the {what} {most}")
        doubt = -np.log1p(-self.levels[can])
        return float(np.interp(-math.log1p(-level), doubt, self.bound[can]))

    def to_json(self) -> dict[str, Any]:
        """As plain values: the sentence, and the figures by level."""
        names = ("bound", "held_least", "held_most", "lost_m")
        figures = {name: getattr(self, name).tolist() for name in names}
        return {"says": self.sentence(), "blocks": self.blocks, "levels": self.levels.tolist(), **figures}

    def sentence(self, level: float = DEFAULT_LEVEL) -> str:
        """The promise at one of the levels, in one line."""
        i = int(np.argmin(np.abs(self.levels - level)))
        if not self.blocks:
            return f"promised at {level:.0%} by the default table: no frames were held out"
        if self.bound[i] <= NEVER:
            return f"not promised at {level:.0%}: held-out frames saw too little of it"
        low, high = (_percent(values[i]) for values in (self.held_least, self.held_most))
        held = low if low == high else f"{low} to {high}"
        return (
            f"promised at {level:.0%}: {held}% held on {self.blocks} frames that the "
            f"map has not seen, {100 * self.lost_m[i]:.1f} cm of clearance lost"
        )


_DEFAULT_BOUNDS = {
    "depth camera": (-2.875, -3.375, -4.125, -9.0, -9.0, -9.0, -12.0, NEVER),
    "lidar": (0.0, -3.375, -4.5, -6.375, -6.75, -9.0, -9.0, -9.0),
}
"""Bounds of LEVELS for an MRFMap that was not calibrated, in voxels of 5 cm, measured by `python -m
benchmarks.lab promise`. Depth camera: the lowest of the house, the room, the coffin scene, rooms with thin
things and the kitchen, which is the lowest from 98% on, because its poses are off by a part of a voxel.
Lidar: the building."""


def default_promise(m: Any) -> FreePromise:
    """The bounds of a map that was not calibrated, by the camera of its keyframes: for any but a lidar's
    those of depth cameras. Raises ConfigError for a
    map of another method than mrf: its log-odds have no table."""
    if not m.METHOD.has_messages:
        raise ConfigError(
            f"a map of the method {m.METHOD.name} has no default for levels of free space: calibrate it "
            "with taichi_mrf.evaluation.free_space.calibrate_free"
        )
    cameras = (getattr(k, "camera", None) for k in m.keyframes.values())
    by_lidar = any(type(c) in (RayTable, SphericalCamera) for c in cameras)
    bound = np.array(_DEFAULT_BOUNDS["lidar" if by_lidar else "depth camera"])
    nothing = np.full(len(LEVELS), np.nan)
    return FreePromise(np.array(LEVELS), bound, nothing, nothing, nothing, blocks=0)


def _percent(share: float) -> str:
    return f"{math.floor(1000 * share) / 10:.1f}"


def free_with(m: Any, points: ArrayLike, level: float, radius_m: float) -> NDArray[np.bool_]:
    """BrickMap.free_with."""
    points_m = checked_points(points)
    radius = real(radius_m, "radius_m", least=0) / m.voxel_size
    is_free = _Judge(m, level)
    free = np.ones(len(points_m), np.bool_)
    reach = math.ceil(radius)
    offsets = np.indices((2 * reach + 1,) * 3).reshape(3, -1).T - reach
    for rows in _pieces(len(points_m), len(offsets)):
        places = points_m[rows, None] / m.voxel_size
        voxels = np.floor(places).astype(np.int64) + offsets
        near = np.maximum(np.maximum(voxels - places, places - voxels - 1), 0)
        reached = (near**2).sum(axis=2) <= radius**2
        told = np.ones(reached.shape, np.bool_)
        told[reached] = is_free(voxels[reached])
        free[rows] = told.all(axis=1)
    return free


def path_free_with(m: Any, points: ArrayLike, radius_m: float, level: float) -> NDArray[np.bool_]:
    """BrickMap.path_free_with."""
    paths, whole = checked_paths(points)
    radius_m = real(radius_m, "radius_m", least=0)
    step_m = max(0.5 * radius_m, 0.25 * m.voxel_size)
    places, path_of = path_places(paths, step_m)
    # Balls so much larger cover the way between two of them.
    there = free_with(m, places, level, math.hypot(radius_m, 0.5 * step_m))
    free = np.ones(len(paths), np.bool_)
    np.logical_and.at(free, path_of, there)
    return free.reshape(whole)


def box_free_with(m: Any, lower: ArrayLike, upper: ArrayLike, level: float) -> bool:
    """BrickMap.box_free_with."""
    first, after = voxels_of_box(lower, upper, m.voxel_size)
    is_free = _Judge(m, level)
    across = after[1:] - first[1:]
    rows = np.indices(tuple(across)).reshape(2, -1).T + first[1:]
    layers = max(1, _AT_ONCE // len(rows))
    for begin in range(int(first[0]), int(after[0]), layers):
        x = np.arange(begin, min(begin + layers, int(after[0])))
        voxels = np.column_stack([np.repeat(x, len(rows)), np.tile(rows, (len(x), 1))])
        if not is_free(voxels).all():
            return False
    return True


def _pieces(count: int, each: int) -> Iterator[slice]:
    step = max(1, _AT_ONCE // each)
    return (slice(begin, begin + step) for begin in range(0, count, step))


class _Judge:
    """Says which voxels are free at a level."""

    def __init__(self, m: Any, level: float) -> None:
        self._most = bound_now(m, level)
        self._decided, self._voxel_size = m.decided, m.voxel_size

    def __call__(self, voxels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Voxels (N, 3) -> (N,)."""
        log_odds, state = states_at(self._decided, (voxels + 0.5) * self._voxel_size)
        return np.asarray((state == FREE) & (log_odds < self._most))


def bound_now(m: Any, level: float) -> float:
    """Log-odds below which free voxels of a map are free at a level. Raises ConfigError for a level that is
    not promised, in a map that is not settled, and in maps in chunks, which promise nothing."""
    if not hasattr(m, "promise"):
        raise ConfigError("a map in chunks promises no level of free space: ask the map it was made from")
    if not getattr(m, "settled", True):
        raise ConfigError("the map has changed since it was inferred, and promises nothing: call infer()")
    return (m.promise or default_promise(m)).most_log_odds(level)


def states_at(m: Any, points_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Log-odds of a decided map at points (N, 3) in metres, and the states that follow, (N,) each."""
    p = np.clip(m.occupancy(points_m).astype(np.float64), 1e-30, 1 - 1e-7)
    return np.log(p / (1 - p)), m.state(points_m)


def refused(m: Any, most_log_odds: float) -> "ti.Ndarray":
    """The log-odds of a decided map's pool in which free voxels that reach a bound are occupied."""
    pool, out = m.view.pool, ti.ndarray(ti.f32, m.view.pool.belief.shape[0])
    _refuse(pool.belief, out, pool.prior_log_odds, m.view.volume.min_evidence, most_log_odds)
    return out


@kernel
def _refuse(log_odds: F32Array, out: F32Array, prior: F32, min_evidence: F32, most: F32) -> None:
    """Copy log-odds (n); free ones that are ``most`` or more become ones of an occupied voxel."""
    for i in out:
        here = log_odds[i]
        if state_of(here, prior, min_evidence) == FREE and here >= most:
            here = ti.abs(prior) + min_evidence + 1.0
        out[i] = here
