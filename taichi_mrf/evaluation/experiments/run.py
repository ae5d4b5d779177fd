"""The papers' experiments by name, and how one is run: its ledger, its parameters beside the results.

This is what `taichi-mrf eval` uses. An experiment's module is imported when it runs.
"""

import importlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

import taichi_mrf
from taichi_mrf import Config
from taichi_mrf.config.schema import to_yaml
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Ledger
from taichi_mrf.evaluation.tables import Table
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_text

Progress = Callable[[str, int, int], None]
"""Called between two maps with what is done, how many parts are done, and how many there are."""


@dataclass(frozen=True)
class Entry:
    """One experiment: "module:function", its own voxel sizes in metres, whether it reads the scenes, and
    whether parts of it can be run alone."""

    function: str
    voxel_sizes: tuple[float, ...]
    needs_data: bool = True
    has_parts: bool = False


EXPERIMENTS = {
    "table1": Entry("taichi_mrf.evaluation.experiments.table1:run_table1", (0.05, 0.02, 0.01)),
    "table2": Entry("taichi_mrf.evaluation.experiments.table2:run_table2", (0.05, 0.02)),
    "table3": Entry("taichi_mrf.evaluation.experiments.table3:run_table3", (0.05, 0.02, 0.01)),
    "fig7": Entry("taichi_mrf.evaluation.experiments.fig7:run_fig7", (0.05, 0.02)),
    "fig8": Entry("taichi_mrf.evaluation.experiments.fig8:run_fig8", (0.05,)),
    "fig9": Entry("taichi_mrf.evaluation.experiments.fig8:run_fig9", (0.05, 0.02)),
    "fig10": Entry("taichi_mrf.evaluation.experiments.fig10:run_fig10", (0.05, 0.02, 0.01)),
    "stereo": Entry("taichi_mrf.evaluation.experiments.stereo.maps:run_stereo", (0.2,)),
    "exact": Entry("taichi_mrf.evaluation.experiments.exact:run_exact", (0.05,)),
    "peers": Entry(
        "taichi_mrf.evaluation.experiments.peers.run:run_peers", (0.05, 0.02, 0.01), has_parts=True
    ),
}


def run_experiment(
    name: str,
    entry: Entry,
    data: Path,
    out: Path,
    voxel_sizes: tuple[float, ...],
    seeds: tuple[int, ...],
    limit: int | None,
    progress: Progress,
    only: tuple[str, ...] = (),
    judge: str | None = None,
) -> tuple[list[Table], list[Path]]:
    """Run an experiment and write its files into ``out``; returns its tables and the files.

    Without ``voxel_sizes`` the experiment's own are used, without ``only`` all of its parts. What an earlier
    run with the same ``out`` has found is not computed again. Raises TaichiMRFError, and what ``progress``
    raises.
    """
    if only and not entry.has_parts:
        raise ConfigError(f"--only: eval {name} has no parts that can be run alone")
    if judge is not None and name != "table3":
        raise ConfigError(f"--judge: eval {name} is not judged by another sensor; table3 is")
    sizes = voxel_sizes or entry.voxel_sizes
    configuration = out / f"{name}_config.yaml"
    write_text(configuration, _configuration(name, sizes, seeds, limit, judge))
    experiment = Experiment(
        data, out, Ledger(out / f"{name}.jsonl", _made_with(data)), sizes, seeds, limit, progress, only, judge
    )
    module, _, function = entry.function.partition(":")
    run = getattr(importlib.import_module(module), function)
    with warnings.catch_warnings():
        # Learnt tables have patches whose sigma falls below zero far away; the tables' notes mention it.
        warnings.filterwarnings("ignore", message="sigma of patch")
        tables, paths = run(experiment)
    return tables, [*paths, configuration]


def _made_with(data: Path) -> dict[str, Any]:
    """Conditions of results beside their keys: the scenes, and the device, on which times depend."""
    choice = runtime.choice()
    return {
        "version": taichi_mrf.__version__,
        "compiler": choice.compiler if choice else None,
        "backend": choice.name if choice else None,
        "device": choice.device if choice else None,
        "data": str(data.resolve()),
    }


def _configuration(
    name: str, sizes: tuple[float, ...], seeds: tuple[int, ...], limit: int | None, judge: str | None
) -> str:
    """The exact parameters: those of the experiment, and those that every map has but for its method's."""
    head = {
        "experiment": name,
        "voxel_sizes": list(sizes),
        "seeds": list(seeds),
        "limit": limit,
        "judge": judge,
        "version": taichi_mrf.__version__,
    }
    return (
        "# How this evaluation was run, and the parameters of its maps where the experiment sets none.\n"
        + yaml.safe_dump({"evaluation": head}, sort_keys=False)
        + "maps:\n"
        + "".join(f"  {line}\n" for line in to_yaml(Config()).splitlines())
    )
