"""Command ``taichi-mrf map`` with several sources, or on a cluster: a task for each, and a summary."""

import csv
import io
import json
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import taichi_mrf
from taichi_mrf.cli.map.earlier import refuse_other_run
from taichi_mrf.cli.map.keep import refuse_changes
from taichi_mrf.cli.map.process import Outcome, finished_before, map_in_process
from taichi_mrf.cli.map.run import exit_status, print_run, run_map
from taichi_mrf.cli.map.task import MapTask, map_task
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest, interrupt_on_signals
from taichi_mrf.cli.shared.output import DID_NOT_FIT, output_folder
from taichi_mrf.cli.shared.print_table import print_table
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.cluster.choose import open_runner
from taichi_mrf.config.schema import load
from taichi_mrf.config.text import commented_yaml, differences
from taichi_mrf.errors import ClusterError, ConfigError, TaichiMRFError
from taichi_mrf.evaluation.pictures.contact_sheet import Tile, write_contact_sheet
from taichi_mrf.evaluation.tables import Table
from taichi_mrf.runs.files import CONFIG_FILE, REPORT_FILE
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.files import exists, is_folder

SUMMARY_JSON, SUMMARY_CSV, SUMMARY_PICTURE = "summary.json", "summary.csv", "summary.png"
_TOP_VIEW = "top_view.png"


@dataclass(frozen=True)
class Row:
    """One sequence in the summary: lengths in metres, ``seconds`` those of the run that mapped it. What is
    not known is None."""

    name: str
    source: str
    status: str
    seconds: float | None = None
    frames: int | None = None
    keyframes: int | None = None
    voxel_size: float | None = None
    voxels: int | None = None
    map_memory_mb: float | None = None
    peak_memory_mb: float | None = None
    median_abs: float | None = None
    rms: float | None = None
    unanswered: float | None = None
    error: str | None = None


_FROM_REPORT = ("frames", "keyframes", "voxel_size", "voxels", "map_memory_mb", "peak_memory_mb")
_FROM_ACCURACY = ("median_abs", "rms", "unanswered")


def summary_row(name: str, source: str, outcome: Outcome) -> Row:
    """The row of one sequence."""
    report = outcome.report
    if report is None:
        return Row(name, source, outcome.status, error=outcome.error)
    accuracy = report["accuracy"] or {}
    known = {key: report[key] for key in _FROM_REPORT} | {key: accuracy.get(key) for key in _FROM_ACCURACY}
    seconds = round(sum(report["seconds"].values()), 3)
    return Row(name, source, outcome.status, seconds, error=outcome.error, **known)


def summary_json(rows: Sequence[Row], facts: dict[str, Any]) -> str:
    """The summary as JSON text: the facts of the whole run, then the sequences."""
    return json.dumps({**facts, "sequences": [asdict(row) for row in rows]}, indent=2) + "\n"


def summary_csv(rows: Sequence[Row]) -> str:
    """The summary as a table for spreadsheets; what is not known is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()


def summary_line(row: Row) -> str:
    """One sequence in one line."""
    if row.seconds is None:
        return f"{row.name}: {row.status}" + (f": {row.error}" if row.error else "")
    return (
        f"{row.name}: {row.status}, {row.keyframes} keyframes, {row.voxels:,} voxels, {accuracy_text(row)}, "
        f"{row.seconds:.1f} s" + (f": {row.error}" if row.error else "")
    )


def accuracy_text(row: Row) -> str:
    """The median error on held-out frames, if there are any."""
    return "not checked" if row.median_abs is None else f"median error {100 * row.median_abs:.2f} cm"


def print_summary(console: Terminal, rows: Sequence[Row]) -> None:
    """The rows as a table, and below it why there are sequences without a map."""
    facts = ("seconds", "keyframes", "voxels", "map MB", "median cm", "RMS cm", "no answer %")
    cells = [
        (
            row.name,
            row.status,
            _number(row.seconds, 1),
            _number(row.keyframes),
            _number(row.voxels),
            _number(row.map_memory_mb),
            _number(row.median_abs, 2, 100.0),
            _number(row.rms, 1, 100.0),
            _number(row.unanswered, 1, 100.0),
        )
        for row in rows
    ]
    errors = [f"{row.name}: {row.error}" for row in rows if row.error]
    print_table(console, Table("summary", "Maps", ("sequence", "state", *facts), cells, errors))


def _number(value: float | None, digits: int = 0, scale: float = 1.0) -> str:
    return "-" if value is None else f"{scale * value:,.{digits}f}"


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


def folder_names(sources: Sequence[str]) -> list[str]:
    """A name for each source: the last part of its path, or a built-in's name; where that is not enough to
    tell them apart, more of the path or the options after the question mark; at last numbers.

    The same sources always give the same names, which differ in more than upper and lower case. Raises
    ConfigError if a source is there twice.
    """
    twice = [source for source, count in Counter(sources).items() if count > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: is named twice")
    choices = [_from_short_to_long(source) for source in sources]
    lengths = [0] * len(sources)
    while True:
        names = [choice[length] for choice, length in zip(choices, lengths, strict=True)]
        counts = Counter(name.casefold() for name in names)
        longer = [
            number
            for number, name in enumerate(names)
            if counts[name.casefold()] > 1 and lengths[number] + 1 < len(choices[number])
        ]
        if not longer:
            return _numbered(names)
        for number in longer:
            lengths[number] += 1


def _from_short_to_long(source: str) -> list[str]:
    """Possible names of the source."""
    path, mark, _ = source.partition("?")
    if exists(Path(source)):
        path, mark = source, ""
    folder = Path(path)
    if folder.name in ("", ".."):
        folder = folder.resolve()
    last = folder.name if is_folder(folder) else folder.stem
    parts = [*(part for part in folder.parent.parts if part != ".."), last]
    names = [_plain("_".join(parts[-count:])) for count in range(1, len(parts) + 1)]
    return [*names, _plain(source)] if mark else names


def _plain(text: str) -> str:
    """The text with nothing in it that a file system or a shell could mind."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("._") or "sequence"


def _numbered(names: list[str]) -> list[str]:
    """The names, with a number behind those that are taken already."""
    taken: set[str] = {name.casefold() for name in names}
    used: set[str] = set()
    unique = []
    for name in names:
        candidate, number = name, 2
        while candidate.casefold() in used or (candidate != name and candidate.casefold() in taken):
            candidate, number = f"{name}_{number}", number + 1
        used.add(candidate.casefold())
        unique.append(candidate)
    return unique
