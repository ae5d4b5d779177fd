"""Command ``taichi-mrf map``: map sequences, check the maps, write the files, print the reports.

One driver holds the folder and the signals. One sequence is mapped in this process, several, or any on a
cluster, by processes of their own, and one too large for a machine in submaps.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import taichi_mrf
from taichi_mrf.cli.map.keep import refuse_changes
from taichi_mrf.cli.map.sequence import Outcome, finished_before, map_in_process, map_to_folder
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
from taichi_mrf.cli.map.task import MapTask, map_task, refuse_other_run
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest, interrupt_on_signals, stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.print_table import print_facts
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal, tell_first_run
from taichi_mrf.cli.shared.terminal import DID_NOT_FIT, READ_WRONG, Terminal, print_problem
from taichi_mrf.cluster.choose import open_runner
from taichi_mrf.config.schema import load
from taichi_mrf.config.text import commented_yaml, differences
from taichi_mrf.errors import ClusterError, TaichiMRFError
from taichi_mrf.evaluation.pictures.figures import write_contact_sheet
from taichi_mrf.runs.files import CONFIG_FILE, MAP_FILE, REPORT_FILE
from taichi_mrf.runs.report import report_json
from taichi_mrf.system.atomic import write_text

LOOK_AT_PICTURES = "Look at the .png files, or open"
OPEN_VOXELS = "voxels.ply in MeshLab, CloudCompare or Blender."
KEPT = "The files are kept; --force ends without this error."
LIVE_VIEW = "shows the map in the browser."


def run_map(options: Map) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError, also after everything is written
    if a sequence has failed."""
    console = open_terminal(options.printing, stderr=options.json)
    several, in_submaps = len(options.sources) > 1, options.submap_size is not None
    here = not (several or in_submaps or options.scheduler is not None)
    work = _map_here if here else _map_in_processes
    if in_submaps:
        from taichi_mrf.cli.map.submaps import map_submaps as work
    signals = stop_on_signals if here else interrupt_on_signals
    with (
        # The task of one sequence on a cluster locks the folder itself.
        output_folder(options.out, locked=here or several or in_submaps),
        signals(lambda text: console.print_line(text, "yellow")) as request,
    ):
        return work(options, console, request)


def _map_here(options: Map, console: Terminal, request: StopRequest) -> int:
    """Map one sequence in this process; returns the exit status."""
    task = map_task(options, options.sources[0], options.out)
    finished = refuse_other_run(task)
    if finished is not None:
        if options.json:
            print(report_json(finished), end="")
        console.print_line(f"{options.out} holds this run already, finished; --overwrite maps it again.")
        return 0
    tell_first_run(options.printing)
    with ProgressBar(console, options.printing) as progress:
        report, written = map_to_folder(task, progress, request)
    print_run(console, options, report, written)
    if not request() and report["refused"] and not options.force:
        print_problem(f"{report['refused']} {KEPT}")
        return READ_WRONG
    if request() or report["did_not_fit"] is None:
        return request.exit_status
    saved = f"the map of {report['keyframes']} keyframes was saved to {options.out}"
    print_problem(f"{report['did_not_fit']}; {saved}; --resume continues it")
    return DID_NOT_FIT


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


def _map_in_processes(options: Map, console: Terminal, request: StopRequest) -> int:
    """Map each sequence in a process of its own, here or on a cluster; returns the exit status. Raises
    TaichiMRFError, also after everything is written if a sequence has failed."""
    start = time.perf_counter()
    names = folder_names(options.sources)
    single = len(names) == 1
    folders = [options.out] if single else [options.out / name for name in names]
    tasks = [map_task(options, *each) for each in zip(options.sources, folders, strict=True)]
    batch = _Batch(options, names, tasks)
    _map_all(batch, console, request)
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
            with request.ending(), open_runner(batch.options.jobs, batch.options.scheduler) as runner:
                waiting = _waiting(batch, done)
                tasks = [batch.tasks[number] for number in waiting]
                runner.run(map_in_process, tasks, lambda index, outcome: done(waiting[index], outcome))
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


def print_run(console: Terminal, options: Map, report: dict[str, Any], written: list[Path]) -> None:
    """Print the result of one source."""
    if options.json:
        print(report_json(report), end="")
        return
    if not options.force:  # it is the error that the command ends with
        report = {**report, "notes": [note for note in report["notes"] if note != report["refused"]]}
    print_report(console, report, written)
    look = LOOK_AT_PICTURES if any(path.suffix == ".png" for path in written) else "Open"
    live = f"taichi-mrf live {options.out / MAP_FILE} {LIVE_VIEW}"
    console.print(f"{look} {OPEN_VOXELS} {live}")


def print_report(console: Terminal, report: dict[str, Any], written: list[Path]) -> None:
    """The report as a table, then what should be known besides, then where the files lie."""
    print_facts(console, f"Map of {report['source']}", _report_rows(report))
    for note in report["notes"]:
        console.print_line(f"Note: {note}")
    for problem in report["skipped_frames"].values():
        console.print_line(f"Skipped: {problem}")
    if report["interrupted"]:
        console.print_line("Stopped before the end; --resume continues from here.", "yellow")
    for path in written:
        console.print_line(str(path))


def _report_rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    seconds = ", ".join(f"{stage} {value:.1f}" for stage, value in report["seconds"].items())
    peak = report["peak_memory_mb"]
    tracking = report["tracking"]
    return [
        ("backend", f"{report['backend']} ({report['device']})"),
        ("method", report["method"]),
        ("frames", f"{report['frames']}, {_keyframes_text(report['keyframes'], report['frozen'])}"),
        *([("tracking", _tracking_text(tracking))] if tracking else []),
        ("rays", f"{report['rays']:,}"),
        ("voxels", f"{report['voxels']:,} of {report['voxel_size']} m in {report['bricks']:,} bricks"),
        (
            "memory",
            f"map {report['map_memory_mb']:.0f} MB" + (f", process {peak:.0f} MB at most" if peak else ""),
        ),
        ("seconds", seconds),
        ("accuracy", _accuracy_text(report["accuracy"])),
        *([("free space", report["free_space"]["says"])] if report["free_space"] else []),
    ]


def _keyframes_text(keyframes: int, frozen: int) -> str:
    if not frozen:
        return f"{keyframes} of them keyframes"
    return f"{keyframes + frozen} of them keyframes, {frozen} frozen outside of the window"


def _tracking_text(tracking: dict[str, int]) -> str:
    text = f"{tracking['frames']} frames found, {tracking['lost']} lost"
    if tracking["unsure"]:
        text += f", {tracking['unsure']} where depth constrained the pose too little"
    return text + (f"; {tracking['loops_closed']} loops closed" if tracking["loops_closed"] else "")


def _accuracy_text(accuracy: dict[str, Any] | None) -> str:
    if accuracy is None:
        return "not checked: no frame was held out"
    if not accuracy["pixels"]:
        return f"{accuracy['frames']} held-out frames have no pixel in common with the map"
    return (
        f"median error {100 * accuracy['median_abs']:.2f} cm, RMS {100 * accuracy['rms']:.1f} cm, "
        f"{100 * accuracy['unanswered']:.1f}% of pixels without an answer "
        f"({accuracy['frames']} held-out frames)"
    )
