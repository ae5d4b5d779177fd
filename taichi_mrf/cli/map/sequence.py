"""Mapping one sequence into its folder, in this process, or as a task in a process of its own."""

import math
import os
import time
import traceback
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from taichi_mrf.calibration.from_recording import LearntSigma, sigma_of_glance
from taichi_mrf.cli.map.keep import Keeper, resumed_map, skipped_before
from taichi_mrf.cli.map.task import MapTask, finished_report, report_in
from taichi_mrf.cli.shared.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.shared.learn_noise import learn_noise
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.registry import is_rendered
from taichi_mrf.datasets.summary import note_unused_color
from taichi_mrf.doctor.diagnosis import doubtful_at_a_glance
from taichi_mrf.doctor.remedy import remedy
from taichi_mrf.errors import DatasetError, ReadWrongError, TaichiMRFError, collected_warnings
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.pipeline import Event, FrameOffered, Listener, WaitingForPoses, map_sequence
from taichi_mrf.mapping.rounds import RoundStep
from taichi_mrf.mapping.tracking import wants_color
from taichi_mrf.runs.files import CONFIG_FILE, MAP_FILE
from taichi_mrf.runs.folder import RunFacts, write_run
from taichi_mrf.runs.noise import contradicts
from taichi_mrf.system import runtime

_PATIENCE_S = 20.0
"""How long to wait for the folder: the process that a lost worker has left may still hold it for a moment."""

Status = Literal["mapped", "finished before", "stopped", "failed", "refused", "not done"]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a sequence: the report of its run, or one line that says why there is none."""

    status: Status
    report: dict[str, Any] | None = None
    error: str | None = None


def map_to_folder(
    task: MapTask, progress: ProgressBar, request: StopRequest
) -> tuple[dict[str, Any], list[Path]]:
    """Map one sequence and write its files into its folder, which exists; returns the report and the files.

    A run that the ``request`` stopped says so in its report; one that has to end within seconds is neither
    checked nor drawn. Raises TaichiMRFError.
    """
    start = time.perf_counter()
    settings = task.settings
    runtime.init(settings.runtime.arch, settings.runtime.threads)
    dataset = task.open(wants_color(settings, task.source, task.options.poses.track_poses))
    if not settings.color and METHODS[settings.method].has_colors:
        note_unused_color(dataset, task.source, task.options.reading)
    settings = with_recorded_noise(settings, dataset)
    if not task.options.force:
        _refuse_what_is_read_wrong(task, dataset)
    previous = resumed_map(task.out, settings) if task.options.resume else None
    skipped = skipped_before(task.out) if task.options.resume else {}
    opening = time.perf_counter() - start

    with collected_warnings() as warned:
        start = time.perf_counter()
        learnt = _learn_noise(task, dataset, settings, progress, request)
        if learnt is not None:
            settings = learnt.put_into(settings)
        took = time.perf_counter() - start
        learning = {"learning noise": took} if took > 0.05 else {}  # most recordings are not looked at
        facts = RunFacts(task.source, settings, dataset, task.choice(), skipped, warned, learnt)
        result = map_sequence(
            dataset,
            settings,
            listener_of(progress),
            every=task.options.every,
            limit=task.options.limit,
            skip_bad_frames=task.options.skip_bad_frames,
            should_stop=request,
            out_of_time=request.out_of_time,
            resume_from=previous,
            keep=Keeper(task.out, settings, task.options.keep_every, facts.unfinished),
            map_path=task.out / MAP_FILE,
        )
        result.seconds = {"opening": opening, **learning, **result.seconds}
        return write_run(
            task.out, result, facts, pictures=task.options.pictures,
            haste=request, advance=progress.advance, mistakes_of=partial(_mistakes, task),
        )  # fmt: skip


def _learn_noise(
    task: MapTask, dataset: Dataset, settings: Config, progress: ProgressBar, request: StopRequest
) -> LearntSigma | None:
    """Noise learnt from the recording, if that was asked for, or if it contradicts the default. A resumed run
    has learnt it."""
    if task.options.resume and (task.out / CONFIG_FILE).is_file():
        return None
    learnt = None
    if task.options.noise.is_learnt:
        learnt = learn_noise(dataset, settings, progress, request, task.options.every, task.options.limit)
    elif task.options.noise.is_checked and not task.options.poses.follow:
        learnt = sigma_of_glance(
            dataset, settings, every=task.options.every, limit=task.options.limit, should_stop=request
        )
    # No noise is learnt from a recording that is not what it is taken for. The check of the map says so, too.
    found = _mistakes(task, dataset) if contradicts(learnt) else []
    if found and not task.options.force:
        raise ReadWrongError(f"{task.source}: {'; '.join(found)}; --force maps it as it is read")
    if found and not settings.evaluation.hold_out:
        dataset.notes.append(f"frames contradict each other: {'; '.join(found)}")
    return None if found else learnt


def _refuse_what_is_read_wrong(task: MapTask, dataset: Dataset) -> None:
    """Raise ReadWrongError for a recording whose frames explain each other in another reading only. Built-in
    scenes are what they are."""
    if is_rendered(task.source) or task.options.poses.follow or not doubtful_at_a_glance(dataset):
        return
    found = _mistakes(task, dataset)
    if found:
        raise ReadWrongError(f"{task.source}: {'; '.join(found)}; --force maps it as it is read")


def _mistakes(task: MapTask, dataset: Dataset) -> list[str]:
    """What is odd in a task's recording, with the command that mends it."""
    try:
        found = remedy(task.source, task.options.poses.file, task.options.reading)
    except DatasetError:  # such as a recording without poses
        return []
    return [found.in_words()] if found.found.findings else []


def listener_of(progress: ProgressBar) -> Listener:
    """Listener that shows the events of the pipeline."""

    def listen(event: Event) -> None:
        if isinstance(event, FrameOffered):
            progress.advance("Adding", event.number, event.frames, int(isinstance(event.answer, Added)))
        elif isinstance(event, WaitingForPoses):
            progress.advance("Waiting for poses", round(event.quiet_s), math.ceil(event.final_s))
        elif isinstance(event, RoundStep):
            done = (event.round - 1) * event.keyframes + event.moved
            progress.advance("Aligning", done, event.rounds * event.keyframes, 1)
        else:
            done = (event.sweep - 1) * event.keyframes + event.keyframe
            progress.advance("Inferring", done, event.sweeps * event.keyframes, 1)

    return listen


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
            status: Status = "refused" if isinstance(error, ReadWrongError) else "failed"
            return Outcome("stopped") if request() else Outcome(status, error=_one_line(error))
    if report and report.get("did_not_fit"):
        return Outcome("failed", report, report["did_not_fit"])
    if report and report.get("refused") and not task.options.force:
        return Outcome("refused", report, report["refused"])
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
