"""``benchmarks.lab trajectory``: the tables of all walks, of their maps, and of cameras that get lost."""

import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.lab.trajectory.following import (
    FIGURES,
    TRACKING,
    configurations,
    error_result,
    recorded_result,
    tracked_result,
)
from benchmarks.lab.trajectory.lost import COLUMNS as LOST_COLUMNS
from benchmarks.lab.trajectory.lost import NOTES as LOST_NOTES
from benchmarks.lab.trajectory.lost import PLACES, lost_entries, lost_result
from benchmarks.lab.trajectory.peers import Open3DTracker, Peer, PeerMissingError
from benchmarks.lab.trajectory.walks import (
    HEIGHT,
    HOLD_OUT,
    KITCHEN,
    WIDTH,
    Source,
    Walk,
    sources,
    walk_name,
)
from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.tables import Entry, Table, write_table

COLUMNS = [
    "walk", "voxels", "poses by", "moves (cm)", "turns (deg)", "frames", "lost", "RMS (cm)", "anchored (cm)",
    "largest (cm)", "end (cm)", "end (deg)", "unsure", "their steps (mm)", "others' (mm)", "CPU (ms)",
]  # fmt: skip
MAP_COLUMNS = ["walk", "voxels", "poses by", "1.5sigma", "5cm", "log-likelihood", "views"]

TRUE, RECORDED = "true", "recorded"
OPEN3D, OPEN3D_GRAPH = "Open3D odometry", "Open3D odometry, pose graph"

JUDGED_HZ = 10.0
"""The maps of walks at this rate and of slower ones are judged."""

_Way = tuple[str, Config, Callable[[], Result]]
"""Source of the poses, the map's configuration, and the function that computes the result."""

NOTES = (
    f"Images of {WIDTH} x {HEIGHT} pixels, with a Kinect 1's noise where they are simulated. Moves, turns: "
    "by how much at most the camera does from one frame to the next.",
    "In colour: the simulated scenes are mottled, and the camera's colour images are given.",
    "RMS: of the positions after rigid alignment with the true trajectory, in the kitchen the recorded one. "
    "Anchored: with the first frames laid on each other; so are the largest error and that at the end.",
    "Unsure: frames of which tracking says that their points do not determine all six degrees of freedom. "
    "Steps: RMS error of the motion to such a frame, and to others.",
    "CPU: CPU time for tracking and adding keyframes, for each frame.",
    "Open3D: odometry from image to image, by depth alone or, in colour, by both, to 4.5 m; its pose graph "
    "connects every fifth image with those that the odometry places within 1 m and 0.6 radians.",
)
MAP_NOTES = (
    f"Mean over held-out views (one frame in {HOLD_OUT}), each aligned with the map first. 1.5sigma = within "
    "1.5 voxels, 5cm = within 5 cm of the clean depth, in the kitchen of the measured one.",
)


def run_trajectory(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """A row for each walk and each way to come by its poses. Raises ConfigError if ``only`` leaves none."""
    walks = {walk_name(source, rate): (source, rate) for source in sources() for rate in source.rates}
    cases = {f"lost, {case}": case for case in PLACES}
    chosen = [part for part in (*walks, *cases) if experiment.wants(part)]
    if not chosen:
        raise ConfigError(f"--only leaves none of: {'; '.join((*walks, *cases))}")
    rows: list[list[Entry]] = []
    map_rows: list[list[Entry]] = []
    lost_rows: list[list[Entry]] = []
    missing = ""
    for voxel_size in experiment.voxel_sizes:
        for number, part in enumerate(chosen):
            experiment.report(f"{part}, {voxel_size * 100:g} cm", number, len(chosen))
            ways = (
                _walked(experiment, *walks[part], voxel_size)
                if part in walks
                else _lost(experiment, cases[part], voxel_size)
            )
            for poses_by, config, compute in ways:
                try:
                    result = experiment.ledger.result(_key(experiment, part, poses_by, config), compute)
                except PeerMissingError as error:
                    missing = str(error)
                    continue
                head: list[Entry] = [part, f"{voxel_size * 100:g} cm", poses_by]
                if part in cases:
                    lost_rows.append([*head, *lost_entries(result)])
                if "frames" in result:
                    rows.append([*head, *_entries(result)])
                if figures := result.get("map"):
                    map_rows.append([*head, *(figures[key] for key in FIGURES), figures["views"]])
    left_out = [f"Open3D's rows are left out: {missing}."] if missing else []
    tables = [
        Table("trajectory", "Tracked walks", COLUMNS, rows, [*NOTES, *left_out], digits=2),
        Table("trajectory_maps", "Maps of tracked walks", MAP_COLUMNS, map_rows, MAP_NOTES),
        Table("trajectory_lost", "Cameras that are covered", LOST_COLUMNS, lost_rows, LOST_NOTES),
    ]
    tables = [table for table in tables if table.rows]
    return tables, [path for table in tables for path in write_table(experiment.out, table)]


def _key(experiment: Experiment, part: str, poses_by: str, config: Config) -> str:
    signature = hashlib.sha256(to_yaml(config).encode()).hexdigest()[:12]
    frames = "all" if experiment.limit is None else experiment.limit
    return f"{part} | {frames} frames | noise {experiment.seeds[0]} | {poses_by} ({signature})"


def _walked(experiment: Experiment, source: Source, rate: float, voxel_size: float) -> Iterator[_Way]:
    """The ways to come by the poses of a walk."""

    @cache
    def walk() -> Walk:  # taken only if something is not known yet
        return source.take(experiment, rate)

    @cache
    def open3d() -> tuple[Open3DTracker, Peer]:
        tracker = Open3DTracker(walk())
        return tracker, tracker.odometry()

    def peer(graph: bool) -> Result:
        tracker, found = open3d()
        found = tracker.pose_graph(found) if graph else found
        return error_result(walk(), found.poses, None, found.cpu_s)

    judged = rate <= JUDGED_HZ
    configs = configurations(voxel_size)
    for name, config in configs.items():
        yield name, config, lambda c=config: tracked_result(walk(), c, judged)  # type: ignore[misc]
    if judged:
        config = configs[TRACKING]
        yield (
            RECORDED if source.name.startswith(KITCHEN) else TRUE,
            config,
            lambda: recorded_result(walk(), config),
        )

    yield OPEN3D, configs[TRACKING], lambda: peer(False)
    yield OPEN3D_GRAPH, configs[TRACKING], lambda: peer(True)


def _lost(experiment: Experiment, case: str, voxel_size: float) -> Iterator[_Way]:
    """Rows for a camera that is covered."""
    for name, config in configurations(voxel_size).items():
        yield name, config, lambda c=config: lost_result(experiment, case, c)  # type: ignore[misc]


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
