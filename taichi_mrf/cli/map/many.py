"""Command ``taichi-mrf map`` with several sources, or on a cluster: a task for each, and a summary."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import taichi_mrf
from taichi_mrf.cli.map.earlier import refuse_other_run
from taichi_mrf.cli.map.keep import refuse_changes
from taichi_mrf.cli.map.process import Outcome, finished_before, map_in_process
from taichi_mrf.cli.map.run import exit_status, print_run, run_map
from taichi_mrf.cli.map.source_names import folder_names
from taichi_mrf.cli.map.summary import (
    Row,
    accuracy_text,
    print_summary,
    summary_csv,
    summary_json,
    summary_line,
    summary_row,
)
from taichi_mrf.cli.map.task import MapTask, map_task
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest, interrupt_on_signals
from taichi_mrf.cli.shared.output import DID_NOT_FIT, output_folder
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.cluster.choose import open_runner
from taichi_mrf.config.schema import load
from taichi_mrf.config.text import commented_yaml, differences
from taichi_mrf.errors import ClusterError, TaichiMRFError
from taichi_mrf.evaluation.pictures.contact_sheet import Tile, write_contact_sheet
from taichi_mrf.runs.files import CONFIG_FILE, REPORT_FILE
from taichi_mrf.system.atomic import write_text

SUMMARY_JSON, SUMMARY_CSV, SUMMARY_PICTURE = "summary.json", "summary.csv", "summary.png"
_TOP_VIEW = "top_view.png"


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


def run(options: Map) -> int:
    """Carry out the command: one sequence here, several or a cluster, or one in submaps; returns the exit
    status. Raises TaichiMRFError."""
    if options.submap_size is not None:
        from taichi_mrf.cli.map.submaps import run_submaps

        return run_submaps(options, options.submap_size)
    return run_map(options) if len(options.sources) == 1 and options.scheduler is None else run_many(options)


def run_many(options: Map) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError, also after everything is written
    if a sequence has failed."""
    console = open_terminal(options.printing, stderr=options.json)
    start = time.perf_counter()
    names = folder_names(options.sources)
    single = len(names) == 1
    folders = [options.out] if single else [options.out / name for name in names]
    tasks = [map_task(options, *each) for each in zip(options.sources, folders, strict=True)]
    batch = _Batch(options, names, tasks)
    with (
        output_folder(options.out, locked=not single),  # the one task locks it itself
        interrupt_on_signals(lambda text: console.print_line(text, "yellow")) as request,
    ):
        _map_all(batch, console, request)
        if single and 0 in batch.outcomes:
            _print_single(batch, console)
        elif not single:
            _print_all(batch, console, time.perf_counter() - start)
    if request():
        return exit_status(request)
    failed = [row for row in batch.rows() if row.status not in ("mapped", "finished before")]
    if failed:
        if single and _did_not_fit(batch.outcomes.get(0)):  # the report says so
            return DID_NOT_FIT
        problem = failed[0].error or failed[0].status
        first = problem if single else f"{failed[0].name}: {problem}"
        others = "" if single else f"{len(failed)} of {len(tasks)} sequences failed, the first: "
        raise TaichiMRFError(f"{others}{first}")
    return 0


def _did_not_fit(outcome: Outcome | None) -> bool:
    """True if memory ran out, and the map so far was saved."""
    return outcome is not None and outcome.report is not None and bool(outcome.report.get("did_not_fit"))


def _map_all(batch: _Batch, console: Terminal, request: StopRequest) -> None:
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
            with open_runner(batch.options.jobs, batch.options.scheduler) as runner:
                waiting = _waiting(batch, done)
                tasks = [batch.tasks[number] for number in waiting]
                runner.run(map_in_process, tasks, lambda index, outcome: done(waiting[index], outcome))
        except KeyboardInterrupt:
            if request.aborted or not request():
                raise
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
        write_contact_sheet(written[-1], _tiles(rows, [task.out for task in batch.tasks]))
    if options.json:
        print(text, end="")
        return
    print_summary(console, rows)
    if any(row.status in ("stopped", "not done") for row in rows):
        console.print_line("Stopped before the end; --resume continues from here.", "yellow")
    for path in written:
        console.print_line(str(path))


def _tiles(rows: Sequence[Row], folders: Sequence[Path]) -> list[Tile]:
    return [
        Tile(row.name, row.status, None, row.error or "")
        if row.seconds is None
        else Tile(row.name, f"{accuracy_text(row)}, {row.seconds:.1f} s", folder / _TOP_VIEW)
        for row, folder in zip(rows, folders, strict=True)
    ]
