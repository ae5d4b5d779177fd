"""``synthetic:floor-plan``: laser scans of the simulated building, with its floor plan as the truth.

Options follow a question mark, ``synthetic:floor-plan?scans=200&beams=181&noise=0.02&seed=1``; the fields of
:class:`FloorPlanOptions` are the options.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.floor_plan import building, way
from taichi_mrf.datasets.laser.scans import LaserScans
from taichi_mrf.datasets.options import parse_options
from taichi_mrf.errors import ConfigError, DatasetError

NAME = "synthetic:floor-plan"


@dataclass(frozen=True)
class FloorPlanOptions:
    """The options of the built-in scans."""

    scans: int = 200
    """Scans, evenly spread along the robot's way."""

    beams: int = 181
    """Beams of a scan, evenly spread over the field of view with both its ends."""

    field_of_view: float = 180.0
    """Angle between the first and the last beam, in degrees; the middle one looks ahead."""

    max_range: float = 8.0
    """Surfaces further away than this (metres) return nothing."""

    noise: float = 0.02
    """Standard deviation of the measured range in metres."""

    seed: int = 0
    """Starts the random numbers; a scan's noise depends on this and its index alone."""

    def __post_init__(self) -> None:
        for name, least in (("scans", 1), ("beams", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} must be at least {least}, not {getattr(self, name)}")
        if not 0 < self.field_of_view <= 360:
            raise ConfigError(f"field_of_view must be up to 360 degrees, not {self.field_of_view}")
        if not 0 < self.max_range < math.inf:
            raise ConfigError(f"max_range must be a positive number of metres, not {self.max_range}")
        if not 0 <= self.noise < math.inf:
            raise ConfigError(f"noise must be a number of metres, not {self.noise}")


def open_floor_plan(source: str) -> LaserScans:
    """The scans of a source such as ``synthetic:floor-plan?scans=50``. Raises DatasetError."""
    name, _, query = source.partition("?")
    if name != NAME:
        raise DatasetError(f"{source}: no such source; the scans that are built in are {NAME}")
    return simulate_scans(parse_options(FloorPlanOptions, query, name))


def simulate_scans(options: FloorPlanOptions) -> LaserScans:
    """Drive through the building and cast every beam. The same options give the same scans."""
    walls = building()
    pose = poses_along(way(), options.scans)
    half = math.radians(options.field_of_view) / 2
    angle = np.linspace(-half, half, options.beams) if options.beams > 1 else np.zeros(1)
    shape = (options.scans, options.beams)
    range_m, hit = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=bool)
    for scan in range(options.scans):
        heading = pose[scan, 2] + angle
        true = walls.ranges(pose[scan, :2], np.stack([np.cos(heading), np.sin(heading)], axis=-1))
        hit[scan] = true <= options.max_range
        noise = np.random.default_rng((options.seed, scan)).normal(0.0, options.noise, options.beams)
        # Without a lower end a beam could come out negative, which no scanner reports.
        measured = np.clip(np.where(hit[scan], true, 0.0) + noise, 0.01, options.max_range)
        range_m[scan] = np.where(hit[scan], measured, options.max_range)
    return LaserScans("floor-plan", range_m, angle, pose, hit, floor_plan=walls.plan())


def poses_along(corners: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Poses (count, 3), x y theta, evenly spread by length from the first corner (P, 2) to the last, each
    looking along its leg of the way."""
    legs = np.array([b - a for a, b in pairwise(corners)])
    lengths = np.hypot(*legs.T)
    ends = np.cumsum(lengths)
    at = np.linspace(0.0, ends[-1], count)
    leg = np.minimum(np.searchsorted(ends, at, side="right"), len(legs) - 1)
    along = (at - (ends - lengths)[leg])[:, None] * legs[leg] / lengths[leg, None]
    return np.column_stack([corners[leg] + along, np.arctan2(legs[leg, 1], legs[leg, 0])])
