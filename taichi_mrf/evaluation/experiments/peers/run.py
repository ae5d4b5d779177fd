"""Every peer on the same frames of a kitchen, a room, a house and a building scanned by a lidar.

Each system maps each frame with each of its settings, and is judged by views that it has not seen: the curve
of quality over what a frame costs. Beside that, what it calls free and occupied, how far its probabilities
can be trusted, and its mesh.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.peers.cases import RIGHT, Case, PeerScene, measured, peer_scenes
from taichi_mrf.evaluation.experiments.peers.peer import Knob, System
from taichi_mrf.evaluation.experiments.peers.systems import MRF, systems
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BUDGETS_MS = (5.0, 10.0, 20.0, 50.0, 150.0, 500.0)
"""Processor time for each frame of the sequence; two cores have 10 ms in 5 ms."""

COST = ("ms a frame", "ms a keyframe", "MB")
ANSWERS = (RIGHT, "within 5 cm", "unanswered", "log-likelihood")
CELLS = ("occupied precision", "occupied recall", "free precision", "free recall", "calibration error")
BUDGET_MS = 10.0
"""Processor time of two cores in 5 ms: the smallest budget that a user is taken to have."""

SHOWN_NATS = 2.2
"""Log-likelihoods that are this much below the best are off the picture."""

MARKERS = "osD^vPX"


@dataclass(frozen=True)
class Point:
    """One setting of a system: processor milliseconds a frame, and what its map is worth. ``selected``: only
    keyframes were mapped; ``standard``: as its makers would run it."""

    system: str
    voxel_size: float
    cpu_ms: float
    right: float
    log_likelihood: float
    selected: bool
    standard: bool


def frontier(points: Sequence[Point], quality: str) -> list[Point]:
    """The settings that no other beats in both time and quality, from fast to slow."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cpu_ms, -getattr(p, quality))):
        if not best or getattr(point, quality) > getattr(best[-1], quality):
            best.append(point)
    return best


def curves(scene: str, points: Sequence[Point]) -> "Figure":
    """Two rows, the share of right pixels and the log-likelihood, over the time of a frame. A line joins the
    settings of a system that no other of its own beats; hollow: keyframes alone; ringed: the standard."""
    sizes = sorted({p.voxel_size for p in points}, reverse=True)
    names = list(dict.fromkeys(p.system for p in points))
    figure = new_figure(4.4 * len(sizes) + 0.6, 7.6)
    rows = (("right", "pixels within 1.5 voxels"), ("log_likelihood", "log-likelihood of a pixel, nats"))
    grid = figure.subplots(len(rows), len(sizes), squeeze=False)
    for line, (quality, label) in zip(grid, rows, strict=True):
        for axes, size in zip(line, sizes, strict=True):
            for number, name in enumerate(names):
                here = [p for p in points if p.system == name and p.voxel_size == size]
                _draw(axes, here, quality, name, number)
            _dress(axes)
            if quality == "log_likelihood":
                best = max(p.log_likelihood for p in points if p.voxel_size == size)
                axes.set_ylim(bottom=max(axes.get_ylim()[0], best - SHOWN_NATS))
        line[0].set_ylabel(label)
    for axes, size in zip(grid[0], sizes, strict=True):
        axes.set_title(f"{scene}, {size * 100:g} cm")
    for axes in grid[-1]:
        axes.set_xlabel("processor ms a frame")
    handles, labels = grid[0][0].get_legend_handles_labels()
    columns = 4 if len(sizes) > 1 else 2
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)
    return figure


def _draw(axes: "Axes", here: Sequence[Point], quality: str, name: str, number: int) -> None:
    """One system's settings."""
    color, marker = f"C{number}", MARKERS[number % len(MARKERS)]
    best = frontier(here, quality)
    axes.plot(
        [p.cpu_ms for p in best], [getattr(p, quality) for p in best], color=color, marker=marker,
        markersize=5, label=name, linewidth=2.6 if number == 0 else 1.3, zorder=5 if number == 0 else 2,
    )  # fmt: skip
    for point in here:
        face = "white" if point.selected else color
        size = 9 if point.standard else 5
        axes.plot(
            point.cpu_ms, getattr(point, quality), marker, color=color, markerfacecolor=face, markersize=size,
            alpha=0.9, zorder=6 if number == 0 else 3,
        )  # fmt: skip


def _dress(axes: "Axes") -> None:
    """A logarithmic axis with plain numbers, and the smallest budget."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.axvline(BUDGET_MS, color="0.6", linestyle=":", linewidth=1)
    axes.grid(alpha=0.3)


@dataclass(frozen=True)
class Row:
    """One setting of one system on one scene."""

    scene: str
    voxel_size: float
    system: str
    knob: Knob
    result: Result

    @property
    def head(self) -> list[Entry]:
        """The first columns of its row in a table."""
        return [self.scene, f"{self.voxel_size * 100:g} cm", self.system, self.knob.name]

    @property
    def point(self) -> Point:
        """Its place in a plot."""
        answers = self.result["answers"]
        return Point(
            self.system, self.voxel_size, self.result["cpu_ms"], answers[RIGHT], answers["log-likelihood"],
            self.knob.selected, self.knob.standard,
        )  # fmt: skip


def budgets(rows: Sequence[Row]) -> Table:
    """The best that each system reaches within a budget, as the share of right pixels / log-likelihood."""
    entries: list[list[Entry]] = []
    for scene, size, system in dict.fromkeys((row.scene, row.voxel_size, row.system) for row in rows):
        points = [r.point for r in rows if (r.scene, r.voxel_size, r.system) == (scene, size, system)]
        within = [[p for p in points if p.cpu_ms <= budget] for budget in BUDGETS_MS]
        cells = [
            f"{max(p.right for p in kept):.3f} / {max(p.log_likelihood for p in kept):.2f}" if kept else None
            for kept in within
        ]
        entries.append([scene, f"{size * 100:g} cm", system, *cells])
    notes = [
        "Share of pixels of held-out views whose first surface is right within 1.5 voxels / mean "
        "log-likelihood of a pixel, each by the setting that is best of those within the budget of "
        "CPU time a frame."
    ]
    columns = [f"{budget:g} ms" for budget in BUDGETS_MS]
    title = "Every peer: what it reaches within a budget"
    return Table("peers_budgets", title, ["scene", "voxels", "system", *columns], entries, notes)


def settings(rows: Sequence[Row]) -> Table:
    """Table of what each setting costs, and how well it answers held-out views."""
    entries: list[list[Entry]] = []
    for row in rows:
        result = row.result
        costs: list[Entry] = [result["cpu_ms"], result["cpu_ms_keyframe"], result["memory_mb"]]
        entries.append([*row.head, *costs, *(result["answers"][name] for name in ANSWERS)])
    notes = [
        "ms: CPU time of all threads, a frame of the sequence and a keyframe that is mapped. MB: the "
        "map's own figure. Shares of the pixels of held-out views whose first surface is right; pixels "
        "without an answer are wrong. Log-likelihood: nats, density per metre.",
        "Recursive maps are read with or without the voxels that are likelier free, whichever is right "
        "more often.",
    ]
    return Table(
        "peers", "Every peer: cost and held-out views",
        ["scene", "voxels", "system", "setting", *COST, *ANSWERS], entries, notes,
    )  # fmt: skip


def states(rows: Sequence[Row]) -> Table:
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


def profile(rows: Sequence[Row]) -> Table:
    """Table of where MRFMap's time goes."""
    ours = [row for row in rows if row.system == MRF]
    stages = list(dict.fromkeys(name for row in ours for name in row.result["stages_ms"]))
    entries: list[list[Entry]] = [
        [*row.head, *(row.result["stages_ms"].get(name) for name in stages)] for row in ours
    ]
    return Table(
        "peers_profile", "MRFMap: processor ms a keyframe by stage",
        ["scene", "voxels", "system", "setting", *stages], entries,
    )  # fmt: skip


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
