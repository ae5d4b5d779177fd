"""Carrying out ``taichi-mrf eval``: the ledger, the progress bar, tables on the terminal."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import taichi_mrf
from taichi_mrf.cli.eval import Eval
from taichi_mrf.cli.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.output import output_folder
from taichi_mrf.cli.print_table import print_table
from taichi_mrf.config.schema import Config, to_yaml
from taichi_mrf.errors import DatasetError, TaichiMRFError
from taichi_mrf.experiments.endless import run_endless
from taichi_mrf.experiments.exact import run_exact
from taichi_mrf.experiments.fig7 import run_fig7
from taichi_mrf.experiments.fig10 import run_fig10
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.ledger import Ledger
from taichi_mrf.experiments.poses import run_poses
from taichi_mrf.experiments.rays import run_rays
from taichi_mrf.experiments.stereo.maps import run_stereo
from taichi_mrf.experiments.submaps.corridor import run_submaps
from taichi_mrf.experiments.table1 import run_table1
from taichi_mrf.experiments.table2 import run_table2
from taichi_mrf.experiments.table3 import run_table3
from taichi_mrf.experiments.tables import Table
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_text

Run = Callable[[Experiment], tuple[list[Table], list[Path]]]

EXPERIMENTS: dict[str, tuple[Run, tuple[float, ...]]] = {
    "table1": (run_table1, (0.05, 0.02, 0.01)),
    "table2": (run_table2, (0.05, 0.02)),
    "table3": (run_table3, (0.05, 0.02, 0.01)),
    "fig7": (run_fig7, (0.05, 0.02)),
    "fig10": (run_fig10, (0.05, 0.02, 0.01)),
    "stereo": (run_stereo, (0.2,)),
    "exact": (run_exact, (0.05,)),
    "poses": (run_poses, (0.05,)),
    "rays": (run_rays, (0.05, 0.02, 0.01)),
    "endless": (run_endless, (0.1,)),
    "submaps": (run_submaps, (0.05,)),
}
"""Name -> what runs it, and its own voxel sizes."""

BUILT_IN_SCENES = {"submaps"}
"""Experiments that need no data."""


def run_eval(options: Eval) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = Console()
    if options.experiment not in BUILT_IN_SCENES and not options.data.is_dir():
        raise DatasetError(f"{options.data}: there is no such folder; --data names the one with the scenes")
    names = list(EXPERIMENTS) if options.experiment == "all" else [options.experiment]
    with (
        output_folder(options.out),
        stop_on_signals(lambda text: console.print(text, style="yellow")) as request,
    ):
        runtime.init(options.runtime.arch, options.runtime.threads, options.runtime.debug)
        failed = 0
        for name in names:
            try:
                tables, paths = _run(name, options, console, request)
            except _StoppedError:
                console.print("Stopped before the end; the same command goes on from here.", style="yellow")
                return 128 + (request.signal or 0)
            except TaichiMRFError as error:
                if len(names) == 1:
                    raise
                # One experiment that lacks its data or an extra does not keep the others from running.
                console.print(f"{name}: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
                failed += 1
                continue
            for table in tables:
                print_table(console, table)
            for path in paths:
                console.print(str(path), markup=False, highlight=False, soft_wrap=True)
    if failed:
        raise TaichiMRFError(f"{failed} of {len(names)} experiments could not be run")
    return 0


class _StoppedError(Exception):
    """The user wants the run to end; what was found is kept."""


def _run(
    name: str, options: Eval, console: Console, should_stop: StopRequest
) -> tuple[list[Table], list[Path]]:
    run, own_sizes = EXPERIMENTS[name]
    sizes = options.voxel_sizes or own_sizes
    configuration = options.out / f"{name}_config.yaml"
    write_text(configuration, _configuration(name, options, sizes))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(name, total=None)

        def report(what: str, done: int, total: int) -> None:
            # Between two maps. An exception raised by the signal itself could be lost in a finaliser.
            if should_stop():
                raise _StoppedError
            progress.update(task, description=f"{name}: {what}", completed=done, total=total)

        experiment = Experiment(
            options.data,
            options.out,
            Ledger(options.out / f"{name}.jsonl", _made_with(options.data)),
            sizes,
            options.seeds,
            options.limit,
            report,
        )
        with warnings.catch_warnings():
            # Learnt tables have patches whose sigma falls below zero far away; the tables' notes say so.
            warnings.filterwarnings("ignore", message="sigma of patch")
            tables, paths = run(experiment)
    return tables, [*paths, configuration]


def _made_with(data: Path) -> dict[str, Any]:
    """What results depend on beside their keys: the scenes, and the device, on which times depend."""
    choice = runtime.choice()
    return {
        "version": taichi_mrf.__version__,
        "backend": choice.name if choice else None,
        "device": choice.device if choice else None,
        "data": str(data.resolve()),
    }


def _configuration(name: str, options: Eval, sizes: tuple[float, ...]) -> str:
    """The exact parameters: those of the experiment, and those that every map has but for its method's."""
    head = {
        "experiment": name,
        "voxel_sizes": list(sizes),
        "seeds": list(options.seeds),
        "limit": options.limit,
        "version": taichi_mrf.__version__,
    }
    return (
        "# How this evaluation was run, and the parameters of its maps where the experiment sets none.\n"
        + yaml.safe_dump({"evaluation": head}, sort_keys=False)
        + "maps:\n"
        + "".join(f"  {line}\n" for line in to_yaml(Config()).splitlines())
    )
