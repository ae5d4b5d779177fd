"""``taichi-mrf eval``: run experiments of the papers, show the progress, print their tables.

The experiments are a package of their own, which is imported by name when the command runs.
"""

import importlib
from collections.abc import Mapping
from typing import Any

from taichi_mrf.cli.options.measure import Eval
from taichi_mrf.cli.shared.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.print_table import print_table
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.values import nearest
from taichi_mrf.errors import ConfigError, DatasetError, TaichiMRFError
from taichi_mrf.system import runtime
from taichi_mrf.system.files import is_folder

LABORATORY = "taichi_mrf.evaluation.experiments.run"
"""The module that has EXPERIMENTS and run_experiment."""

ALL = "all"


def run_eval(options: Eval, experiments: Mapping[str, Any] | None = None) -> int:
    """Carry out the command, with other ``experiments`` than the papers' if there are any; returns the exit
    status. Raises TaichiMRFError."""
    console = open_terminal(options.printing)
    laboratory = importlib.import_module(LABORATORY)
    known = laboratory.EXPERIMENTS if experiments is None else experiments
    if options.experiment not in (*known, ALL):
        hint = nearest(options.experiment, [*known, ALL])
        raise ConfigError(f"unknown experiment '{options.experiment}'; {hint}")
    names = list(known) if options.experiment == ALL else [options.experiment]
    if any(known[name].needs_data for name in names) and not is_folder(options.data):
        raise DatasetError(f"{options.data}: no such folder; --data must name the folder with the scenes")
    with (
        output_folder(options.out),
        stop_on_signals(lambda text: console.print_line(text, "yellow")) as request,
    ):
        runtime.init(options.runtime.arch, options.runtime.threads)
        failed = 0
        for name in names:
            try:
                tables, paths = _run(laboratory.run_experiment, name, known[name], options, console, request)
            except _StoppedError:
                console.print_line("Stopped before the end; the same command continues from here.", "yellow")
                return request.exit_status
            except TaichiMRFError as error:
                if len(names) == 1:
                    raise
                # One experiment that lacks its data or an extra does not keep the others from running.
                console.print_line(f"{name}: {error}", "red")
                failed += 1
                continue
            for table in tables:
                print_table(console, table)
            for path in paths:
                console.print_line(str(path))
    if failed:
        raise TaichiMRFError(f"{failed} of {len(names)} experiments could not be run")
    return 0


class _StoppedError(Exception):
    """The user has stopped the run; the results so far are kept."""


def _run(run: Any, name: str, entry: Any, options: Eval, console: Terminal, should_stop: StopRequest) -> Any:
    """The tables and the files of one experiment, with a progress bar on a terminal."""
    with ProgressBar(console, options.printing) as progress:

        def report(what: str, done: int, total: int) -> None:
            # Between two maps. An exception raised by the signal itself could be lost in a finaliser.
            if should_stop():
                raise _StoppedError
            progress.advance(name, done, total, note=what)

        return run(
            name, entry, options.data, options.out, options.voxel_sizes, options.seeds, options.limit, report,
            options.only, options.judge,
        )  # fmt: skip
