"""`benchmarks.lab changes`: log-odds tuned on other scenes, all methods on all scripts, and the tables.

Each script is run with other places and times than those that the baselines are tuned on (TUNED_ON).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.lab.change_runs import (
    FRAMES,
    FRESH_S,
    WATCHED_S,
    ChangeContender,
    clamped_log_odds,
    dated_mrf,
    moving_truth,
    perfect_drives,
    run_script,
    static_mrf,
)
from benchmarks.lab.moving_truth import MovingTruth
from benchmarks.lab.robot_paths import LENGTH_M, PLAY_M, RADIUS_M
from taichi_mrf.datasets.synthetic.room import SCRIPTS
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.tables import Entry, Table, write_table

TUNED_ON = 10
"""The seed of the scenes that the baselines are tuned on."""

SEEDS = 2
"""So many of the experiment's seeds are used: other places, times and noise."""

CLAMPED, DECAY = "log-odds, clamped (OctoMap)", "log-odds with decay"

HITS, MISSES = (0.7, 0.85, 0.95), (0.2, 0.3, 0.4, 0.45)
HALF_LIVES_S, WITH_DECAY = (3.0, 10.0, 30.0), ((0.7, 0.4), (0.85, 0.3), (0.95, 0.2))
"""The grids: each hit with each miss, and each half-life with each pair of hit and miss."""

FIRST_WALK_S = 18
"""Nobody has walked before."""

TARGETS = {
    "came_views": 3.0,
    "left_views": 10.0,
    "trail": 0.02,
    "new_lost": 0.1,
    "points_lost": 0.02,
}
"""Fields of Figures, and what is good."""


def run_changes(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Changes in the maps, and things that a robot which trusts them hits."""
    frames = min(FRAMES, experiment.limit or FRAMES)
    seeds = [seed for seed in experiment.seeds if seed != TUNED_ON][:SEEDS]
    changes: list[list[Entry]] = []
    drives: list[list[Entry]] = []
    tuned = [_best(experiment, grid, frames) for grid in (_clamped(), _decaying())]
    contenders = [static_mrf(), dated_mrf(), *tuned]
    for voxel_size in experiment.voxel_sizes:
        for contender in contenders:
            results = {
                script: [_result(experiment, contender, script, seed, voxel_size, frames) for seed in seeds]
                for script in SCRIPTS
            }
            head: list[Entry] = [contender.name, f"{voxel_size * 100:g} cm"]
            changes.append([*head, *Figures.of([r for each in results.values() for r in each]).entries()])
            drives.append([*head, *_drive_entries(results)])
    perfect = {
        script: [{"drives": asdict(perfect_drives(_truth(script, seed, frames)))} for seed in seeds]
        for script in SCRIPTS
    }
    drives.append(["the true scene", "-", *_drive_entries(perfect)])
    tables = [
        _change_table(changes, frames, len(seeds), [f"{c.name}: {c.parameters}." for c in contenders]),
        _drive_table(drives),
    ]
    return tables, [path for table in tables for path in write_table(experiment.out, table)]


def _clamped() -> list[ChangeContender]:
    return [clamped_log_odds(CLAMPED, hit, miss) for hit in HITS for miss in MISSES]


def _decaying() -> list[ChangeContender]:
    return [
        clamped_log_odds(DECAY, hit, miss, half_life_s)
        for half_life_s in HALF_LIVES_S
        for hit, miss in WITH_DECAY
    ]


def _best(experiment: Experiment, grid: Sequence[ChangeContender], frames: int) -> ChangeContender:
    """The contender that comes nearest to all TARGETS on the scenes for tuning, at the experiment's first
    voxel size."""
    voxel_size = experiment.voxel_sizes[0]

    def cost(contender: ChangeContender) -> float:
        figures = Figures.of([
            _result(experiment, contender, script, TUNED_ON, voxel_size, frames, tuning=True)
            for script in SCRIPTS
        ])  # fmt: skip
        shares = [getattr(figures, name) / target for name, target in TARGETS.items()]
        return sum(share for share in shares if math.isfinite(share))

    return min(grid, key=cost)


def _result(
    experiment: Experiment,
    contender: ChangeContender,
    script: str,
    seed: int,
    voxel_size: float,
    frames: int,
    tuning: bool = False,
) -> Result:
    """One run from the ledger, or a new one."""
    what = f"{contender.name} ({contender.parameters}) | {script} {seed} | {voxel_size:g} m"
    experiment.report(what, experiment.ledger.computed, experiment.ledger.computed + 1)
    key = f"{what} | {frames} frames" + (" | tuning" if tuning else "")
    return experiment.ledger.result(
        key, lambda: run_script(contender, _truth(script, seed, frames), voxel_size, tuning)
    )


@cache
def _truth(script: str, seed: int, frames: int) -> MovingTruth:
    return moving_truth(script, seed, frames)


@dataclass(frozen=True)
class Figures:
    """Means over some runs; NaN where there is nothing to average."""

    came: int
    came_of: int
    came_views: float
    left: int
    left_of: int
    left_views: float
    trail: float
    trail_at_end: float
    new_lost: float
    precision: float
    recall: float
    walls_lost: float
    points_lost: float
    no_surface: float
    in_the_air: float

    @staticmethod
    def of(results: Sequence[Result]) -> "Figures":
        """Over the runs of one method. What a map has not shown counts as one view more than there were."""
        came, left = ([watch for r in results for watch in r[name]] for name in ("came", "left"))
        trails = [r["trail"] for r in results if r["trail"]]
        points, in_map, in_layer, voxels, right = (
            sum(r["new"][name] for r in results)
            for name in ("points", "in_map", "in_layer", "voxels", "right")
        )
        return Figures(
            sum(watch["after"] is not None for watch in came),
            len(came),
            _mean(watch["after"] or watch["seen"] + 1 for watch in came),
            sum(watch["after"] is not None for watch in left),
            len(left),
            _mean(watch["after"] or watch["seen"] + 1 for watch in left),
            _mean(share for trail in trails for share in trail[FIRST_WALK_S:]),
            _mean(trail[-1] for trail in trails),
            1 - in_map / points if points else float("nan"),
            right / voxels if voxels else float("nan"),
            in_layer / points if voxels and points else float("nan"),
            sum(r["walls_lost"] for r in results) / max(1, sum(r["walls"] for r in results)),
            _mean(r["points_lost"] for r in results),
            _mean(r["no_surface"] for r in results),
            _mean(r["in_the_air"] for r in results),
        )

    def entries(self) -> list[Entry]:
        """As columns of the table."""
        return [
            self.came_views,
            f"{self.came} of {self.came_of}",
            self.left_views,
            f"{self.left} of {self.left_of}",
            100 * self.trail,
            100 * self.trail_at_end,
            100 * (1 - self.new_lost),
            100 * self.precision,
            100 * self.recall,
            100 * self.walls_lost,
            100 * self.points_lost,
            100 * self.no_surface,
            100 * self.in_the_air,
        ]


def _mean(values: Iterable[float]) -> float:
    known = list(values)
    return float(np.mean(known)) if known else float("nan")


def _change_table(
    rows: Sequence[Sequence[Entry]], frames: int, seeds: int, parameters: Sequence[str]
) -> Table:
    columns = [
        "map", "voxels", "newcomer, views", "shown", "ghost, views", "gone", "trail %", "trail at the end %",
        "new shown %", "layer precision %", "layer recall %", "walls lost %", "surfaces lost %",
        "no surface %", "in the air %",
    ]  # fmt: skip
    return Table(
        "changes",
        f"A room that changes: {len(SCRIPTS)} scripts, {frames} keyframes a second apart, {seeds} seeds",
        columns,
        rows,
        [
            "newcomer: views that see a thing until half of the voxels are occupied that a map of these "
            f"views alone would show; ghost: views until under 5% are left; both within {WATCHED_S:g} s, and "
            "one view more where they did not suffice.",
            "trail: voxels that someone has walked through and left, but that are occupied, of all in the "
            "swept volume; mean over the keyframes since somebody came, and after the last one.",
            f"new: points of what came to its place less than {FRESH_S:g} s ago, as each view shows them, "
            "with an occupied voxel within 5 cm; recall: with one of the dynamic layer. precision: voxels of "
            "the layer near something that was not there at the start.",
            "walls lost: voxels of walls and furniture that a map of the same views without anything that "
            "moves shows, and that have no occupied voxel in or beside them; surfaces lost: the same for "
            "true points. no surface: occupied voxels that no surface passes through; in the air: those of "
            "them that are more than 10 cm from any.",
            *parameters,
        ],
        digits=1,
    )


def _drive_entries(results: Mapping[str, Sequence[Result]]) -> list[Entry]:
    """Collisions per 1000 m for each script and for all, and what was driven and refused."""
    sums = {
        name: {script: sum(r["drives"][name] for r in runs) for script, runs in results.items()}
        for name in ("taken", "hit", "free", "refused")
    }
    total = {name: sum(each.values()) for name, each in sums.items()}
    per_script = [_per_1000_m(sums["hit"][script], sums["taken"][script]) for script in results]
    return [
        *per_script,
        _per_1000_m(total["hit"], total["taken"]),
        round(total["taken"] * LENGTH_M),
        total["hit"],
        100 * total["refused"] / max(1, total["free"]),
    ]


def _per_1000_m(hits: int, taken: int) -> float:
    return 1000 * hits / (taken * LENGTH_M) if taken else float("nan")


def _drive_table(rows: Sequence[Sequence[Entry]]) -> Table:
    return Table(
        "changes_drives",
        "Collisions per 1000 m of a robot that trusts the map",
        ["map", "voxels", *SCRIPTS, "all", "metres driven", "collisions", "free paths refused %"],
        rows,
        [
            f"Level straight paths of {LENGTH_M:g} m by a ball of {100 * RADIUS_M:g} cm radius, planned "
            "where every voxel is FREE as of the newest keyframe, up to a second old.",
            f"Collision: a surface enters the ball by more than {100 * PLAY_M:g} cm. Free: none comes within "
            f"{100 * PLAY_M:g} cm of the ball. The true scene is that at the time of the keyframe.",
        ],
        digits=1,
    )
