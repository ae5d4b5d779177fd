"""Leave one out: maps of all views but one, judged on that one, for every contender and voxel size."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.experiments.contenders import Contender, row_name
from taichi_mrf.evaluation.experiments.judging import build_and_judge
from taichi_mrf.evaluation.experiments.ledger import Ledger
from taichi_mrf.evaluation.experiments.scenes import Scene

Report = Callable[[str, int, int], None]
"""Called with what is being worked on, how much of it is done, and out of how much."""


@dataclass(frozen=True)
class Experiment:
    """Settings of an experiment."""

    data: Path
    """Folder with the scenes."""

    out: Path
    """Folder for tables and pictures."""

    ledger: Ledger
    """Results that are known already."""

    voxel_sizes: Sequence[float] = (0.05, 0.02, 0.01)
    """Voxel sizes in metres."""

    seeds: Sequence[int] = (0, 1, 2, 3)
    """Draws of the noise: the first for all contenders, the others for MRFMap only."""

    limit: int | None = None
    """Use no more than this many views or folds of a scene."""

    report: Report = field(default=lambda what, done, total: None)

    only: Sequence[str] = ()
    """Patterns of the parts to run, as ``room, 10 Hz`` or ``kitchen*``; empty for all."""

    judge: str | None = None
    """Parameter file or shipped configuration of a sensor that judges Table III in the recording's place."""

    def wants(self, part: str) -> bool:
        """True if a part is to be run."""
        return not self.only or any(fnmatchcase(part, pattern) for pattern in self.only)


@dataclass(frozen=True)
class Scored:
    """The figures of one judged view under one row of a table."""

    row: str
    voxel_size: float
    seed: int
    view: str
    figures: dict[str, Any]
    build_seconds: float


def fold_key(scene: Scene, seed: int, contender: Contender, voxel_size: float, fold: object) -> str:
    """Under which a fold's result is kept: it changes with whatever the result depends on."""
    signature = contender.signature(scene, voxel_size)
    return f"{scene.name} | noise {seed} | {contender.name} ({signature}) | {voxel_size:g} m | {fold}"


def flatten(result: dict[str, Any], contender: str, voxel_size: float, seed: int) -> Iterable[Scored]:
    """A fold's result as one entry for each reading and judged view."""
    for reading, views in result["readings"].items():
        for view, figures in views.items():
            yield Scored(
                row_name(contender, reading), voxel_size, seed, view, figures, result["build_seconds"]
            )


def leave_one_out(
    experiment: Experiment,
    scene: Scene,
    seed: int,
    contenders: Sequence[Contender],
    voxel_size: float,
) -> list[Scored]:
    """Every view of a scene judged by maps of the other views."""
    scored: list[Scored] = []
    count = len(scene.views)
    folds = range(count)[: experiment.limit]
    for contender in contenders:
        for fold in folds:
            others = [i for i in range(count) if i != fold]
            experiment.report(f"{contender.name}, {voxel_size * 100:g} cm, noise {seed}", fold, len(folds))
            result = experiment.ledger.result(
                fold_key(scene, seed, contender, voxel_size, scene.views[fold].name),
                lambda c=contender, o=others, f=fold: build_and_judge(c, scene, voxel_size, o, [f]),  # type: ignore[misc]
            )
            scored += flatten(result, contender.name, voxel_size, seed)
    return scored


def require_views(scene: Scene, least: int) -> None:
    """Raise ConfigError for a scene with fewer views than an experiment needs."""
    if len(scene.views) < least:
        raise ConfigError(f"{scene.name}: {len(scene.views)} views; the experiment needs at least {least}")
