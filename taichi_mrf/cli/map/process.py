"""One of several sequences, as a task in a process of its own."""

import json
import os
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from taichi_mrf.cli.map.run import MapTask, map_to_folder
from taichi_mrf.cli.shared.interrupt import stop_on_signals
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.schema import load
from taichi_mrf.config.text import differences
from taichi_mrf.errors import MapFileError, TaichiMRFError
from taichi_mrf.runs.folder import CONFIG_FILE, MAP_FILE, REPORT_FILE, VOXEL_FILE

Status = Literal["mapped", "finished before", "stopped", "failed", "not done"]

_FILES = (MAP_FILE, VOXEL_FILE, CONFIG_FILE)


@dataclass(frozen=True)
class Outcome:
    """What has become of a sequence: the report of its run, or in one line why there is none."""

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
            finished = finished_before(task)
            if finished is not None:
                return finished
            map_to_folder(task, silent, request)
            report = _report_in(task.out)
        except Exception as error:
            return Outcome("stopped") if request() else Outcome("failed", error=_one_line(error))
    if report and report.get("did_not_fit"):
        return Outcome("failed", report, report["did_not_fit"])
    return Outcome("stopped" if report and report["interrupted"] else "mapped", report)


def finished_before(task: MapTask) -> Outcome | None:
    """The outcome of a complete run of the same task, if the folder holds it. A folder that holds another
    sequence is a failure."""
    try:
        report = _finished_report(task)
    except TaichiMRFError as error:
        return Outcome("failed", error=str(error))
    return None if report is None else Outcome("finished before", report)


def _finished_report(task: MapTask) -> dict[str, Any] | None:
    """The report in the task's folder, if its run was complete and the same."""
    report = _report_in(task.out)
    if report is None or not all((task.out / name).is_file() for name in _FILES):
        return None
    if report.get("source") != task.source:
        raise MapFileError(f"{task.out}: holds the map of {report.get('source')}")
    changed = differences(load(task.out / CONFIG_FILE), task.settings)
    same = task.choice().items() <= report.items() and all(name.startswith("runtime.") for name in changed)
    return report if same and not report.get("interrupted") else None


def _report_in(folder: Path) -> dict[str, Any] | None:
    path = folder / REPORT_FILE
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise MapFileError(f"{path}: cannot be read: {error}") from error
    if not isinstance(report, dict):
        raise MapFileError(f"{path}: is no report")
    return report


def _one_line(error: Exception) -> str:
    """The text of an error. One that this package does not raise on purpose is told in full on stderr."""
    if isinstance(error, TaichiMRFError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'input or output'}: {error.strerror or error}"
    traceback.print_exception(error)
    return " ".join(f"{type(error).__name__}: {error}".split())
