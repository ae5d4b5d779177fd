"""``eval trajectory``: the tables of all walks, of the maps that they give, and of cameras that get lost."""

import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.trajectory.following import (
    CLOSES_LOOPS,
    FIGURES,
    configuration,
    recorded_result,
    tracked_result,
)
from taichi_mrf.experiments.trajectory.walks import (
    HEIGHT,
    HOLD_OUT,
    KITCHEN,
    WIDTH,
    Source,
    Walk,
    sources,
    walk_name,
)

COLUMNS = [
    "walk", "voxels", "poses by", "moves (cm)", "turns (deg)", "frames", "lost", "RMS (cm)", "anchored (cm)",
    "largest (cm)", "end (cm)", "end (deg)", "unsure", "their steps (mm)", "others' (mm)", "CPU (ms)",
]  # fmt: skip
MAP_COLUMNS = ["walk", "voxels", "poses by", "1.5sigma", "5cm", "log-likelihood", "views"]

TRACKING, LOOPS_CLOSED = "tracking", "tracking, loops closed"
TRUE, RECORDED = "true", "recorded"

JUDGED_HZ = 10.0
"""The maps of walks at this rate and of slower ones are judged."""

NOTES = (
    f"Images of {WIDTH} x {HEIGHT} pixels, with a Kinect 1's noise where they are simulated. Moves, turns: "
    "by how much at most the camera does from one frame to the next.",
    "RMS: of the positions after rigid alignment with the true trajectory, in the kitchen the recorded one. "
    "Anchored: with the first frames laid on each other; so are the largest error and that at the end.",
    "Unsure: frames of which tracking says that their points do not determine all six degrees of freedom. "
    "Steps: RMS error of the motion to such a frame, and to others.",
    "CPU: processor time for tracking and adding keyframes, for each frame.",
)
MAP_NOTES = (
    f"Mean over held-out views (one frame in {HOLD_OUT}), each aligned with the map first. 1.5sigma = within "
    "1.5 voxels, 5cm = within 5 cm of the clean depth, in the kitchen of the measured one.",
)


def run_trajectory(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """A row for each walk and each way to come by its poses. Raises ConfigError if ``only`` leaves none."""
    walks = [(source, rate) for source in sources() for rate in source.rates]
    chosen = [each for each in walks if experiment.wants(walk_name(*each))]
    if not chosen:
        raise ConfigError(f"--only leaves none of: {'; '.join(walk_name(*each) for each in walks)}")
    rows: list[list[Entry]] = []
    map_rows: list[list[Entry]] = []
    for voxel_size in experiment.voxel_sizes:
        for number, (source, rate) in enumerate(chosen):
            name = walk_name(source, rate)
            experiment.report(f"{name}, {voxel_size * 100:g} cm", number, len(chosen))
            for poses_by, result in _results(experiment, source, rate, voxel_size):
                head: list[Entry] = [name, f"{voxel_size * 100:g} cm", poses_by]
                if "frames" in result:
                    rows.append([*head, *_entries(result)])
                if figures := result.get("map"):
                    map_rows.append([*head, *(figures[key] for key in FIGURES), figures["views"]])
    tables = [Table("trajectory", "Tracked walks", COLUMNS, rows, NOTES, digits=2)]
    if map_rows:
        tables.append(Table("trajectory_maps", "Maps of tracked walks", MAP_COLUMNS, map_rows, MAP_NOTES))
    return tables, [path for table in tables for path in write_table(experiment.out, table)]


def _results(
    experiment: Experiment, source: Source, rate: float, voxel_size: float
) -> Iterator[tuple[str, Result]]:
    """What is known of one walk, or is computed, by the name of what found its poses."""

    @cache
    def walk() -> Walk:  # taken only if something is not known yet
        return source.take(experiment, rate)

    judged = rate <= JUDGED_HZ
    ways: dict[str, tuple[Config, Callable[[], Result]]] = {}
    for name, close_loops in ((TRACKING, False), *([(LOOPS_CLOSED, True)] if CLOSES_LOOPS else [])):
        config = configuration(voxel_size, close_loops)
        ways[name] = config, lambda c=config: tracked_result(walk(), c, judged)  # type: ignore[misc]
    if judged:
        config = configuration(voxel_size, close_loops=False)
        ways[RECORDED if source.name == KITCHEN else TRUE] = config, lambda: recorded_result(walk(), config)
    for name, (config, compute) in ways.items():
        signature = hashlib.sha256(to_yaml(config).encode()).hexdigest()[:12]
        frames = "all" if experiment.limit is None else experiment.limit
        head = f"{walk_name(source, rate)} | {frames} frames | noise {experiment.seeds[0]}"
        key = f"{head} | {name} ({signature})"
        yield name, experiment.ledger.result(key, compute)


def _entries(result: Result) -> list[Entry]:
    """A row of the first table, in its units."""
    return [
        100 * result["moves_m"],
        float(np.degrees(result["turns_rad"])),
        result["of"],
        result["lost"],
        100 * result["rms_m"],
        100 * result["anchored_rms_m"],
        100 * result["anchored_largest_m"],
        100 * result["end_m"],
        float(np.degrees(result["end_rad"])),
        result["unsure"],
        *(None if result[key] is None else 1000 * result[key] for key in ("unsure_step_m", "sure_step_m")),
        1000 * result["cpu_s"],
    ]
