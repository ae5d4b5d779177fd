"""Cost of a new keyframe, and memory of the map, as old keyframes become more.

A sequence is mapped in laps, each of which takes other frames of it. Either every lap is moved to a place of
its own, far from all others, so that a new keyframe sees none of the earlier laps' keyframes; or all laps are
at one place, and it sees them. Straight lines are fitted to both.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.table import Table

from taichi_mrf import Config, Frame, MRFMap
from taichi_mrf.cli.bench import BenchRun, Measured
from taichi_mrf.evaluation.keyframe_cost import Seconds, add_timed, warm_up
from taichi_mrf.evaluation.pictures.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAPS = 8

PLACES_APART_M = 100.0
"""Distance of the places, which lie on a grid of 3 x 3: voxels of 1 cm span 655 m."""

Kind = Literal["unseen", "seen"]

KIND_COLORS = {"unseen": "#4477aa", "seen": "#ee6677"}
KIND_NAMES = {"unseen": "old keyframes that it does not see", "seen": "old keyframes that it sees"}


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


def measure_laps(run: BenchRun) -> Measured:
    """Cost and memory against the number of earlier keyframes, in view and out of view."""
    rows: list[Growth] = []
    kinds: tuple[Kind, Kind] = ("unseen", "seen")
    for kind in kinds:
        for config, advance in run.each_size(f", {kind}"):
            rows.append(measure_growth(run.frames, config, kind, advance))
    rows.sort(key=lambda row: -row.voxel_size)
    draw = partial(draw_growth, rows, run.title)
    return [growth_table(rows, run.title)], [row.to_json() for row in rows], draw


def growth_table(rows: Sequence[Growth], title: str) -> Table:
    """One row for each voxel size and kind: fitted lines, and their values at a thousand keyframes."""
    table = Table(title=f"New keyframes beside old ones: {title}", title_justify="left")
    table.add_column("")
    table.add_column("old ones")
    for name in ("alone, ms", "whole (mean), ms", "processors, ms", "memory, MB"):
        table.add_column(name, justify="right")
    figures: list[tuple[Callable[[Lap], float], float]] = [
        (lambda lap: lap.alone.wall, 1e3),
        (lambda lap: lap.whole.wall, 1e3),
        (lambda lap: lap.whole.cpu, 1e3),
        (lambda lap: lap.memory_mb, 1.0),
    ]
    for row in rows:
        texts = [_line(row.line(figure), scale) for figure, scale in figures]
        table.add_row(f"{row.voxel_size * 100:g} cm", row.kind, *texts)
    table.caption = (
        "At no old keyframe + for each old one (± standard error). Alone: without re-inference of others; "
        "processors: their time for the whole."
    )
    table.caption_justify = "left"
    return table


def _line(line: Line, scale: float) -> str:
    error = "" if line.slope_error is None else f" ± {line.slope_error * scale:.4f}"
    return f"{line.at_zero * scale:.1f} + {line.slope * scale:.4f}{error}"


def draw_growth(rows: Sequence[Growth], title: str) -> "Figure":
    """Cost and memory against the number of old keyframes, seen and unseen, with straight lines fitted."""
    sizes = sorted({row.voxel_size for row in rows}, reverse=True)
    figure = new_figure(4.4 * len(sizes) + 0.6, 7.4)
    figure.suptitle(f"A new keyframe in a growing map: {title}", fontsize=9, wrap=True)
    panels = figure.subplots(2, len(sizes), squeeze=False)
    for column, size in enumerate(sizes):
        for row in (row for row in rows if row.voxel_size == size):
            _draw_line(panels[0, column], row, lambda lap: lap.whole.wall * 1e3, "ms")
            _draw_line(panels[1, column], row, lambda lap: lap.memory_mb, "MB")
        panels[0, column].set(title=f"{size * 100:g} cm", ylabel="whole cost of a new keyframe, ms")
        panels[1, column].set(ylabel="memory of the map, MB", xlabel="old keyframes")
    for axes in panels.flat:
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize=7, loc="best")
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_line(axes: "Axes", row: Growth, figure: Callable[[Lap], float], unit: str) -> None:
    color, old = KIND_COLORS[row.kind], [lap.old for lap in row.laps]
    line = row.line(figure)
    error = "" if line.slope_error is None else f" ± {line.slope_error:.2g}"
    label = f"{KIND_NAMES[row.kind]}: {line.slope:+.2g}{error} {unit} each"
    axes.plot(old, [figure(lap) for lap in row.laps], "o", color=color, markersize=4.0)
    ends = [old[0], old[-1]]
    axes.plot(ends, [line.at(x) for x in ends], color=color, label=label)
