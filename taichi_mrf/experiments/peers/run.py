"""Every peer on the same frames of a kitchen, a room, a house and a building scanned by a lidar.

Each system maps each frame with each of its settings, and is judged by views that it has not seen: the curve
of quality over what a frame costs. Beside that, what it calls free and occupied, how far its probabilities
can be trusted, and its mesh.
"""

from pathlib import Path

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.tables import Table, write_table
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.peers.cases import PeerScene, peer_scenes
from taichi_mrf.experiments.peers.measuring import Case, measured
from taichi_mrf.experiments.peers.peer import Knob, System
from taichi_mrf.experiments.peers.plots import curves
from taichi_mrf.experiments.peers.systems import systems
from taichi_mrf.experiments.peers.tables import Row, budgets, profile, settings, states
from taichi_mrf.system.atomic import atomic_path


def run_peers(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Results of each system within a budget of time, all settings, states and meshes, MRFMap's profile, and
    a plot for each scene.

    A part, for --only, is a scene, a voxel size and a system, such as "kitchen, 5 cm, OctoMap".
    """
    rows: list[Row] = []
    for scene in peer_scenes(experiment.data, experiment.seeds[0], experiment.limit):
        for size in experiment.voxel_sizes:
            rows += _rows(experiment, scene, size)
    if not rows:
        raise ConfigError(
            f"--only: no part matches {', '.join(experiment.only)}; one is 'kitchen, 5 cm, OctoMap'"
        )
    tables = [budgets(rows), settings(rows), states(rows), profile(rows)]
    paths = [path for table in tables for path in write_table(experiment.out, table)]
    for name in dict.fromkeys(row.scene for row in rows):
        points = [row.point for row in rows if row.scene == name]
        paths.append(experiment.out / f"peers_{name}.png")
        with atomic_path(paths[-1]) as part:
            curves(name, points).savefig(part, format="png", dpi=100)
    return tables, paths


def _rows(experiment: Experiment, scene: PeerScene, voxel_size: float) -> list[Row]:
    case: list[Case] = []

    def computed(system: System, knob: Knob) -> Result:
        if not case:  # not made where all results are known
            case.append(scene.case(voxel_size))
        return measured(system, knob, case[0])

    rows: list[Row] = []
    place = f"{scene.name}, {voxel_size * 100:g} cm"
    wanted = [s for s in systems(scene.is_lidar) if experiment.wants(f"{place}, {s.name}")]
    if not wanted:
        return rows
    combinations = [
        (system, knob)
        for system in wanted
        for knob in system.knobs
        if scene.selects or not knob.selected  # else it would be the same once more
    ]
    for number, (system, knob) in enumerate(combinations):
        experiment.report(f"{place}, {system.name}", number, len(combinations))
        parameters = ", ".join(f"{name} {value}" for name, value in knob.parameters.items())
        key = (
            f"{scene.name} | {experiment.limit} views | noise {experiment.seeds[0]} | {voxel_size:g} m | "
            f"{system.name} | {knob.name} | {knob.stride} | {parameters}"
        )
        result = experiment.ledger.result(key, lambda s=system, k=knob: computed(s, k))  # type: ignore[misc]
        rows.append(Row(scene.name, voxel_size, system.name, knob, result))
    return rows
