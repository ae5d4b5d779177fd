"""One of several sequences, as a task in a process of its own."""

import os
import traceback
from dataclasses import dataclass
from typing import Any, Literal

from taichi_mrf.cli.map.earlier import finished_report, report_in
from taichi_mrf.cli.map.run import map_to_folder
from taichi_mrf.cli.map.task import MapTask
from taichi_mrf.cli.shared.interrupt import stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.errors import TaichiMRFError

_PATIENCE_S = 20.0
"""How long to wait for the folder: the process that a lost worker has left may still hold it for a moment."""

Status = Literal["mapped", "finished before", "stopped", "failed", "not done"]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a sequence: the report of its run, or one line that says why there is none."""

    status: Status
    report: dict[str, Any] | None = None
    error: str | None = None


def map_in_process(task: MapTask) -> Outcome:
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
                map_to_folder(task, silent, request)
                report = report_in(task.out)
        except Exception as error:
            return Outcome("stopped") if request() else Outcome("failed", error=_one_line(error))
    if report and report.get("did_not_fit"):
        return Outcome("failed", report, report["did_not_fit"])
    return Outcome("stopped" if report and report["interrupted"] else "mapped", report)


def finished_before(task: MapTask) -> Outcome | None:
    """The outcome of a complete run of the same task, if the folder holds it. A folder that holds another
    sequence is a failure."""
    try:
        report = finished_report(task)
    except TaichiMRFError as error:
        return Outcome("failed", error=str(error))
    return None if report is None else Outcome("finished before", report)


def _one_line(error: Exception) -> str:
    """The text of an error. The traceback of an unexpected one goes to stderr."""
    if isinstance(error, TaichiMRFError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'input or output'}: {error.strerror or error}"
    traceback.print_exception(error)
    return " ".join(f"{type(error).__name__}: {error}".split())
