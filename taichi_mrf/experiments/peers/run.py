"""Every peer on the same frames of a kitchen, a room, a house and a building scanned by a lidar.

Each system maps each frame with each of its settings, and is judged by views that it has not seen: the curve
of quality over what a frame costs. Beside that, what it calls free and occupied, how far its probabilities
can be trusted, and its mesh.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.peers.cases import PeerScene, peer_scenes
from taichi_mrf.experiments.peers.measuring import RIGHT, Case, measured
from taichi_mrf.experiments.peers.peer import Knob, System
from taichi_mrf.experiments.peers.plots import Point, curves
from taichi_mrf.experiments.peers.systems import MRF, systems
from taichi_mrf.system.atomic import atomic_path

COST = ("ms a frame", "ms a keyframe", "MB")
ANSWERS = (RIGHT, "within 5 cm", "unanswered", "log-likelihood")
CELLS = ("occupied precision", "occupied recall", "free precision", "free recall", "calibration error")


@dataclass(frozen=True)
class _Row:
    """One setting of one system on one scene."""

    scene: str
    voxel_size: float
    system: str
    knob: Knob
    result: Result

    @property
    def head(self) -> list[Entry]:
        return [self.scene, f"{self.voxel_size * 100:g} cm", self.system, self.knob.name]


def run_peers(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """The table of all settings, that of states and meshes, MRFMap's profile, and a plot for each scene.

    A part, for --only, is a scene with a voxel size, such as "kitchen, 5 cm".
    """
    rows: list[_Row] = []
    for scene in peer_scenes(experiment.data, experiment.seeds[0], experiment.limit):
        for size in experiment.voxel_sizes:
            if experiment.wants(f"{scene.name}, {size * 100:g} cm"):
                rows += _rows(experiment, scene, size)
    if not rows:
        raise ConfigError(f"--only: no part matches {', '.join(experiment.only)}; one is 'kitchen, 5 cm'")
    tables = [_settings(rows), _states(rows), _profile(rows)]
    paths = [path for table in tables for path in write_table(experiment.out, table)]
    for name in dict.fromkeys(row.scene for row in rows):
        points = [_point(row) for row in rows if row.scene == name]
        paths.append(experiment.out / f"peers_{name}.png")
        with atomic_path(paths[-1]) as part:
            curves(name, points).savefig(part, format="png", dpi=100)
    return tables, paths


def _rows(experiment: Experiment, scene: PeerScene, voxel_size: float) -> list[_Row]:
    case: list[Case] = []

    def computed(system: System, knob: Knob) -> Result:
        if not case:  # not made where all results are known
            case.append(scene.case(voxel_size))
        return measured(system, knob, case[0])

    rows = []
    settings = [
        (system, knob)
        for system in systems(scene.is_lidar)
        for knob in system.knobs
        if scene.selects or not knob.selected  # else it would be the same once more
    ]
    for number, (system, knob) in enumerate(settings):
        experiment.report(f"{scene.name}, {voxel_size * 100:g} cm, {system.name}", number, len(settings))
        parameters = ", ".join(f"{name} {value}" for name, value in knob.parameters.items())
        key = (
            f"{scene.name} | {experiment.limit} views | noise {experiment.seeds[0]} | {voxel_size:g} m | "
            f"{system.name} | {knob.name} | {knob.stride} | {parameters}"
        )
        result = experiment.ledger.result(key, lambda s=system, k=knob: computed(s, k))  # type: ignore[misc]
        rows.append(_Row(scene.name, voxel_size, system.name, knob, result))
    return rows


def _point(row: _Row) -> Point:
    result = row.result
    return Point(
        row.system, row.voxel_size, result["cpu_ms"], result["answers"][RIGHT],
        result["answers"]["log-likelihood"], row.knob.selected, row.knob.standard,
    )  # fmt: skip


def _settings(rows: Sequence[_Row]) -> Table:
    """What each setting costs, and how well it answers held-out views."""
    entries: list[list[Entry]] = []
    for row in rows:
        result = row.result
        costs: list[Entry] = [result["cpu_ms"], result["cpu_ms_keyframe"], result["memory_mb"]]
        entries.append([*row.head, *costs, *(result["answers"][name] for name in ANSWERS)])
    notes = [
        "ms: processor time of all threads, a frame of the sequence and a keyframe that is mapped. MB: the "
        "map's own figure. Shares of the pixels of held-out views whose first surface is right; pixels "
        "without an answer are wrong. Log-likelihood: nats, density per metre.",
        "Recursive maps are read with or without the voxels that are likelier free, whichever is right "
        "more often.",
    ]
    return Table(
        "peers", "Every peer: cost and held-out views",
        ["scene", "voxels", "system", "setting", *COST, *ANSWERS], entries, notes,
    )  # fmt: skip


def _states(rows: Sequence[_Row]) -> Table:
    """Free and occupied against the truth, calibration and mesh, of the settings as their makers run them."""
    entries: list[list[Entry]] = []
    for row in rows:
        if not row.knob.standard:
            continue
        for reading, scores in row.result["cells"].items():
            name = f"{row.system}, {reading}" if reading else row.system
            mesh = row.result["mesh"] or {}
            figures = [scores[column] for column in CELLS]
            surface = [mesh.get("f_2cm"), mesh.get("f_5cm")] if reading != "calibrated" else [None, None]
            entries.append([row.scene, f"{row.voxel_size * 100:g} cm", name, *figures, *surface])
    notes = [
        "Room and house: voxels that clean rays of the mapped views cross or end in. Kitchen and lidar: "
        "points on the rays of held-out views, one at the measurement, four in front of it. Open3D has "
        "states, no probabilities: 1, 0 and, unknown, one half. F: of the mesh against the true surface.",
    ]
    return Table(
        "peers_states", "Every peer: free and occupied",
        ["scene", "voxels", "map", *CELLS, "F 2 cm", "F 5 cm"], entries, notes,
    )  # fmt: skip


def _profile(rows: Sequence[_Row]) -> Table:
    """Where MRFMap's time goes."""
    ours = [row for row in rows if row.system == MRF]
    stages = list(dict.fromkeys(name for row in ours for name in row.result["stages_ms"]))
    entries: list[list[Entry]] = [
        [*row.head, *(row.result["stages_ms"].get(name) for name in stages)] for row in ours
    ]
    return Table(
        "peers_profile", "MRFMap: processor ms a keyframe by stage",
        ["scene", "voxels", "system", "setting", *stages], entries,
    )  # fmt: skip
