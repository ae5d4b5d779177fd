"""Map sequences in processes of their own, here or on a cluster, and sum them up.

Each is a task that fails alone. The summary is written when all have ended.
"""

import os
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import taichi_mrf
from taichi_mrf.cli.map.keep import refuse_changes
from taichi_mrf.cli.map.lines import KEPT, print_run
from taichi_mrf.cli.map.summary import (
    SUMMARY_CSV,
    SUMMARY_JSON,
    SUMMARY_PICTURE,
    Row,
    folder_names,
    print_summary,
    summary_csv,
    summary_json,
    summary_line,
    summary_row,
    tiles,
)
from taichi_mrf.cli.map.task import (
    MapTask,
    Outcome,
    Status,
    finished_before,
    map_task,
    refuse_other_run,
    report_in,
)
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.terminal import DID_NOT_FIT, READ_WRONG, Terminal, print_problem
from taichi_mrf.cluster.choose import open_runner
from taichi_mrf.config.schema import load
from taichi_mrf.config.text import commented_yaml, differences
from taichi_mrf.errors import ClusterError, ReadWrongError, TaichiMRFError
from taichi_mrf.evaluation.pictures.figures import write_contact_sheet
from taichi_mrf.session.files import CONFIG_FILE, REPORT_FILE
from taichi_mrf.system.atomic import write_text

MapOne = Callable[[MapTask, ProgressBar, StopRequest], tuple[dict[str, Any], list[Path]]]
"""Maps one sequence into its folder, which exists; returns the report and the files."""

_PATIENCE_S = 20.0
"""Longest wait for the folder: the process that a lost worker has left may still hold it for a moment."""


@dataclass
class _Batch:
    """The tasks of a command and their outcomes, by the task's index."""

    options: Map
    names: list[str]
    tasks: list[MapTask]
    outcomes: dict[int, Outcome] = field(default_factory=dict)

    def rows(self) -> list[Row]:
        """A row for each sequence, in the order in which they were named."""
        return [self.row(number) for number in range(len(self.tasks))]

    def row(self, number: int) -> Row:
        """The row of one sequence."""
        outcome = self.outcomes.get(number, Outcome("not done"))
        return summary_row(self.names[number], self.tasks[number].source, outcome)


def map_several(options: Map, console: Terminal, request: StopRequest, map_one: MapOne) -> int:
    """Map each sequence in a process of its own, here or on a cluster, where ``map_one`` maps it; returns the
    exit status. Raises TaichiMRFError, also after everything is written if a sequence has failed."""
    start = time.perf_counter()
    names = folder_names(options.sources)
    single = len(names) == 1
    folders = [options.out] if single else [options.out / name for name in names]
    tasks = [map_task(options, *each) for each in zip(options.sources, folders, strict=True)]
    batch = _Batch(options, names, tasks)
    _map_all(batch, console, request, map_one)
    if not single:
        _print_all(batch, console, time.perf_counter() - start)
    elif 0 in batch.outcomes:
        _print_single(batch, console)
    failed = [row for row in batch.rows() if row.status not in ("mapped", "finished before")]
    if request() or not failed:
        return request.exit_status
    if single and failed[0].status == "refused":
        kept = f" {KEPT}" if batch.outcomes[0].report else ""
        print_problem(f"{failed[0].error}{kept}")
        return READ_WRONG
    if single and _did_not_fit(batch.outcomes.get(0)):  # the report says so
        return DID_NOT_FIT
    problem = failed[0].error or failed[0].status
    first = problem if single else f"{failed[0].name}: {problem}"
    others = "" if single else f"{len(failed)} of {len(tasks)} sequences failed, the first: "
    raise TaichiMRFError(f"{others}{first}")


def _did_not_fit(outcome: Outcome | None) -> bool:
    """True if memory ran out, and the map so far was saved."""
    return outcome is not None and outcome.report is not None and bool(outcome.report.get("did_not_fit"))


def _map_all(batch: _Batch, console: Terminal, request: StopRequest, map_one: MapOne) -> None:
    """Run the tasks and fill in their outcomes, until the user stops the run."""
    count = len(batch.tasks)
    with ProgressBar(console, batch.options.printing) as bar:

        def done(number: int, outcome: Outcome) -> None:
            batch.outcomes[number] = outcome
            if console.is_terminal:  # elsewhere the lines below show the same
                bar.advance("Mapping", len(batch.outcomes), count)
            line = f"[{len(batch.outcomes)}/{count}] {summary_line(batch.row(number))}"
            console.print_line(line)

        if console.is_terminal:
            bar.advance("Mapping", 0, count)
        waiting: list[int] = []
        try:
            with request.ending(), open_runner(batch.options.jobs, batch.options.scheduler) as runner:
                waiting = _waiting(batch, done)
                tasks = [batch.tasks[number] for number in waiting]
                work = partial(_map_in_process, map_one)
                runner.run(work, tasks, lambda index, outcome: done(waiting[index], outcome))
        except ClusterError as error:
            if not error.lost:
                raise
            for index, what in error.lost.items():
                done(waiting[index], Outcome("failed", error=what))


def _waiting(batch: _Batch, done: Callable[[int, Outcome], None]) -> list[int]:
    """The tasks that are not finished: with --overwrite all, for which an old report must not pass for a
    finished run. Raises ConfigError for folders that hold other runs."""
    if len(batch.tasks) > 1:
        path, settings = batch.options.out / CONFIG_FILE, batch.tasks[0].settings
        if path.is_file() and not batch.options.overwrite:
            refuse_changes(path, differences(load(path), settings))
        write_text(path, commented_yaml(settings))
    waiting = []
    for number, task in enumerate(batch.tasks):
        if batch.options.overwrite:
            (task.out / REPORT_FILE).unlink(missing_ok=True)
        refuse_other_run(task)
        outcome = finished_before(task)
        if outcome is None:
            waiting.append(number)
        else:
            done(number, outcome)
    return waiting


def _print_single(batch: _Batch, console: Terminal) -> None:
    outcome, out = batch.outcomes[0], batch.options.out
    if outcome.report is not None:
        written = sorted(path for path in out.iterdir() if path.is_file() and not path.name.startswith("."))
        print_run(console, batch.options, outcome.report, written)


def _print_all(batch: _Batch, console: Terminal, seconds: float) -> None:
    """Write and print the summary."""
    options, rows = batch.options, batch.rows()
    facts = {
        "version": taichi_mrf.__version__,
        "jobs": options.jobs,
        "scheduler": options.scheduler,
        "seconds": round(seconds, 3),
    }
    text = summary_json(rows, facts)
    written = [options.out / SUMMARY_JSON, options.out / SUMMARY_CSV]
    write_text(written[0], text)
    write_text(written[1], summary_csv(rows))
    if options.pictures:
        written.append(options.out / SUMMARY_PICTURE)
        write_contact_sheet(written[-1], tiles(rows, [task.out for task in batch.tasks]))
    if options.json:
        print(text, end="")
        return
    print_summary(console, rows)
    if any(row.status in ("stopped", "not done") for row in rows):
        console.print_line("Stopped before the end; --resume continues from here.", "yellow")
    for path in written:
        console.print_line(str(path))


def _map_in_process(map_one: MapOne, task: MapTask) -> Outcome:
    """Map the sequence, unless it is finished already. A failure is an outcome too, so that it does not stop
    the other sequences."""
    silent = ProgressBar(Terminal(quiet=True))
    with stop_on_signals(lambda text: None) as request:
        try:
            os.chdir(task.start)
            with output_folder(task.out, patience_s=_PATIENCE_S):
                finished = finished_before(task)
                if finished is not None:
                    return finished
                map_one(task, silent, request)
                report = report_in(task.out)
        except Exception as error:
            status: Status = "refused" if isinstance(error, ReadWrongError) else "failed"
            return Outcome("stopped") if request() else Outcome(status, error=_one_line(error))
    if report and report.get("did_not_fit"):
        return Outcome("failed", report, report["did_not_fit"])
    if report and report.get("refused") and not task.options.force:
        return Outcome("refused", report, report["refused"])
    return Outcome("stopped" if report and report["interrupted"] else "mapped", report)


def _one_line(error: Exception) -> str:
    """The text of an error. The traceback of an unexpected one goes to stderr."""
    if isinstance(error, TaichiMRFError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'input or output'}: {error.strerror or error}"
    traceback.print_exception(error)
    return " ".join(f"{type(error).__name__}: {error}".split())
