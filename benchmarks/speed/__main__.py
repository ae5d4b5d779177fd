"""``python -m benchmarks.speed SOURCE --measure NAME``: measurements with the flags of `taichi-mrf bench`."""

import sys
from dataclasses import dataclass
from typing import Literal

import tyro

from benchmarks.speed.growth import measure_laps
from benchmarks.speed.profile import measure_profile
from benchmarks.speed.queries import measure_queries
from benchmarks.speed.viewer import measure_viewer
from taichi_mrf.cli.bench import run_bench
from taichi_mrf.cli.options.measure import Bench
from taichi_mrf.errors import TaichiMRFError

MEASURES = {
    "profile": measure_profile,
    "growth": measure_laps,
    "queries": measure_queries,
    "viewer": measure_viewer,
}


@dataclass(frozen=True, kw_only=True)
class Speed(Bench):
    """Measure where the time of a new keyframe goes, and what else costs time."""

    measure: Literal["profile", "growth", "queries", "viewer"]
    """``profile``: every kernel next to the bound that memory bandwidth sets, and the host's functions.
    ``growth``: cost and memory with the number of earlier keyframes, in view and out of view: eight laps of
    the frames, at one place and at places 100 m apart. ``queries``: how many points, balls and rays a second
    a planner can ask about, and the cost of distances, of the whole map and after one more keyframe, beside
    OctoMap, SciPy and Open3D. ``viewer``: what each keyframe costs the live view."""


def main() -> int:
    """The exit status."""
    options = tyro.cli(Speed, prog="python -m benchmarks.speed")
    name = options.measure
    try:
        return run_bench(options, name, MEASURES[name], profile=name == "profile")
    except TaichiMRFError as error:
        print(error, file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
