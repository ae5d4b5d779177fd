"""Cost of a new keyframe, and memory of the map, as old keyframes become more.

A sequence is mapped in laps, each of which takes other frames of it. Either every lap is moved to a place of
its own, far from all others, so that a new keyframe sees none of the earlier laps' keyframes; or all laps are
at one place, and it sees them. Straight lines are fitted to both.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from taichi_mrf import Config, Frame, MRFMap
from taichi_mrf.benchmark.keyframe_cost import Seconds, add_timed, warm_up

LAPS = 8

PLACES_APART_M = 100.0
"""Distance of the places, which lie on a grid of 3 x 3: voxels of 1 cm span 655 m."""

Kind = Literal["unseen", "seen"]


@dataclass(frozen=True)
class Lap:
    """``old`` keyframes there were in the map before it; medians over the lap's new ones, in seconds, and for
    ``whole``, the re-inference of others in it, the mean, because few of them cause most of that;
    ``memory_mb`` of the map (10^6 bytes, MapStatistics) and the number of ``bricks`` after it."""

    old: int
    allocate: Seconds
    own_sweep: Seconds
    reinference: Seconds
    alone: Seconds
    whole: Seconds
    memory_mb: float
    bricks: int


@dataclass(frozen=True)
class Line:
    """A straight line fitted by least squares: its value at no old keyframe, its slope for one of them, and
    the slope's standard error (None for fewer than three points)."""

    at_zero: float
    slope: float
    slope_error: float | None

    def at(self, x: float) -> float:
        """Its value at ``x`` old keyframes."""
        return self.at_zero + self.slope * x


@dataclass(frozen=True)
class Growth:
    """One voxel size and one kind of old keyframes."""

    voxel_size: float
    kind: Kind
    laps: list[Lap]

    def line(self, figure: Callable[[Lap], float]) -> Line:
        """The line through a figure of the laps. The first is left out of it where there are enough: the
        pool grows most often there."""
        laps = self.laps[1:] if len(self.laps) > 3 else self.laps
        return fit_line([lap.old for lap in laps], [figure(lap) for lap in laps])

    def to_json(self) -> dict[str, Any]:
        """All figures and lines under their names; seconds and megabytes for one old keyframe."""
        lines = {
            "alone": asdict(self.line(lambda lap: lap.alone.wall)),
            "alone_cpu": asdict(self.line(lambda lap: lap.alone.cpu)),
            "whole": asdict(self.line(lambda lap: lap.whole.wall)),
            "whole_cpu": asdict(self.line(lambda lap: lap.whole.cpu)),
            "memory_mb": asdict(self.line(lambda lap: lap.memory_mb)),
        }
        return asdict(self) | {"lines": lines}


def fit_line(x: Sequence[float], y: Sequence[float]) -> Line:
    """Least squares; a level line through a single point."""
    if len(x) < 2:
        return Line(y[0], 0.0, None)
    design = np.stack([np.ones(len(x)), np.asarray(x, np.float64)], axis=1)
    (at_zero, slope), *_ = np.linalg.lstsq(design, np.asarray(y, np.float64), rcond=None)
    error = None
    if len(x) > 2:
        rest = np.asarray(y) - design @ (at_zero, slope)
        error = float(np.sqrt(rest @ rest / (len(x) - 2) * np.linalg.inv(design.T @ design)[1, 1]))
    return Line(float(at_zero), float(slope), error)


def measure_growth(
    frames: Sequence[Frame], config: Config, kind: Kind, progress: Callable[[int], object] | None = None
) -> Growth:
    """Map the frames in laps of equal length; those left over at the end are not used."""
    laps = min(LAPS, len(frames))
    each = len(frames) // laps
    warm_up(MRFMap.from_config(config, frames[0].camera), frames)
    m = MRFMap.from_config(config, frames[0].camera)
    found = []
    for number in range(laps):
        costs = []
        for step in range(each):
            frame = frames[number + step * laps]
            costs.append(add_timed(m, elsewhere(frame, number) if kind == "unseen" else frame))
            if progress is not None:
                progress(number * each + step + 1)
        size = m.statistics()
        found.append(
            Lap(
                old=number * each,
                allocate=Seconds.median([c.allocate for c in costs]),
                own_sweep=Seconds.median([c.own_sweep for c in costs]),
                reinference=Seconds.median([c.reinference for c in costs]),
                alone=Seconds.median([c.alone for c in costs]),
                whole=Seconds.mean([c.whole for c in costs]),
                memory_mb=size.memory_mb,
                bricks=size.bricks,
            )
        )
    return Growth(config.voxel_size, kind, found)


def elsewhere(frame: Frame, place: int) -> Frame:
    """Copy of the frame taken at one of the 3 x 3 places."""
    T_world_camera = frame.T_world_camera.copy()
    T_world_camera[:2, 3] += PLACES_APART_M * (np.array(divmod(place, 3)) - 1.0)
    return replace(frame, T_world_camera=T_world_camera)
