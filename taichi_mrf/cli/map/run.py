"""Command ``taichi-mrf map``: map a sequence, check the map, write the files, print the report."""

import math
import time
from pathlib import Path
from typing import Any

from rich.table import Table

from taichi_mrf.calibration.from_recording import LearntSigma, sigma_of_glance
from taichi_mrf.cli.map.earlier import refuse_other_run
from taichi_mrf.cli.map.keep import Keeper, resumed_map, skipped_before
from taichi_mrf.cli.map.task import MapTask, map_task
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.shared.learn_noise import learn_noise
from taichi_mrf.cli.shared.output import DID_NOT_FIT, output_folder
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal, tell_first_run
from taichi_mrf.cli.shared.terminal import Terminal, print_problem
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.summary import note_unused_color
from taichi_mrf.doctor.diagnosis import mistakes
from taichi_mrf.errors import collected_warnings
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.pipeline import Event, FrameOffered, Listener, WaitingForPoses, map_sequence
from taichi_mrf.mapping.rounds import RoundStep
from taichi_mrf.mapping.tracking import wants_color
from taichi_mrf.runs.files import CONFIG_FILE, MAP_FILE
from taichi_mrf.runs.folder import RunFacts, write_run
from taichi_mrf.runs.noise import contradicts
from taichi_mrf.runs.report import report_json
from taichi_mrf.system import runtime

LOOK_AT_PICTURES = "Look at the .png files, or open"
OPEN_VOXELS = "voxels.ply in MeshLab, CloudCompare or Blender."
LIVE_VIEW = "shows the map in the browser."


def run_map(options: Map) -> int:
    """Carry out the command for one source; returns the exit status. Raises TaichiMRFError."""
    console = open_terminal(options.printing, stderr=options.json)
    task = map_task(options, options.sources[0], options.out)
    with (
        output_folder(task.out),
        stop_on_signals(lambda text: console.print_line(text, "yellow")) as request,
    ):
        finished = refuse_other_run(task)
        if finished is not None:
            _print_finished(console, options, finished)
            return 0
        tell_first_run(options.printing)
        with ProgressBar(console, options.printing) as progress:
            report, written = map_to_folder(task, progress, request)
        print_run(console, options, report, written)
    if report["did_not_fit"] is not None and request.signal is None:
        saved = f"the map of {report['keyframes']} keyframes was saved to {options.out}"
        print_problem(f"{report['did_not_fit']}; {saved}; --resume continues it")
    return exit_status(request, report["did_not_fit"])


def _print_finished(console: Terminal, options: Map, report: dict[str, Any]) -> None:
    if options.json:
        print(report_json(report), end="")
    console.print_line(f"{options.out} holds this run already, finished; --overwrite maps it again.")


def print_run(console: Terminal, options: Map, report: dict[str, Any], written: list[Path]) -> None:
    """Print the result of one source."""
    if options.json:
        print(report_json(report), end="")
        return
    print_report(console, report, written)
    look = LOOK_AT_PICTURES if any(path.suffix == ".png" for path in written) else "Open"
    live = f"taichi-mrf live {options.out / MAP_FILE} {LIVE_VIEW}"
    console.print(f"{look} {OPEN_VOXELS} {live}")


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
    dataset = task.open(wants_color(settings, task.source, task.poses.track_poses))
    if not settings.color and METHODS[settings.method].has_colors:
        note_unused_color(dataset, task.source, task.reading)
    settings = with_recorded_noise(settings, dataset)
    previous = resumed_map(task.out, settings) if task.resume else None
    skipped = skipped_before(task.out) if task.resume else {}
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
            every=task.every,
            limit=task.limit,
            skip_bad_frames=task.skip_bad_frames,
            should_stop=request,
            out_of_time=request.out_of_time,
            resume_from=previous,
            keep=Keeper(task.out, settings, task.keep_every, facts.unfinished),
            map_path=task.out / MAP_FILE,
        )
        result.seconds = {"opening": opening, **learning, **result.seconds}
        return write_run(
            task.out, result, facts, pictures=task.pictures,
            haste=request, advance=progress.advance,
        )  # fmt: skip


def _learn_noise(
    task: MapTask, dataset: Dataset, settings: Config, progress: ProgressBar, request: StopRequest
) -> LearntSigma | None:
    """Noise learnt from the recording, if that was asked for, or if it contradicts the default. A resumed run
    has learnt it."""
    if task.resume and (task.out / CONFIG_FILE).is_file():
        return None
    learnt = None
    if task.noise.is_learnt:
        learnt = learn_noise(dataset, settings, progress, request, task.every, task.limit)
    elif task.noise.is_checked and not task.poses.follow:
        learnt = sigma_of_glance(dataset, settings, every=task.every, limit=task.limit, should_stop=request)
    # No noise is learnt from a recording that is not what it is taken for. The check of the map says so, too.
    found = mistakes(dataset) if contradicts(learnt) else []
    if found and not settings.evaluation.hold_out:
        dataset.notes.append(f"frames contradict each other: {'; '.join(found)}")
    return None if found else learnt


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


def exit_status(request: StopRequest, did_not_fit: str | None = None) -> int:
    """0, or what a shell expects of a program that was stopped by a signal, or DID_NOT_FIT."""
    if request.signal is not None:
        return 128 + request.signal
    return 0 if did_not_fit is None else DID_NOT_FIT


def print_report(console: Terminal, report: dict[str, Any], written: list[Path]) -> None:
    """The report as a table, then what should be known besides, then where the files lie."""
    table = Table(show_header=False, title=f"Map of {report['source']}", title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for name, text in _report_rows(report):
        table.add_row(name, text)
    console.print(table)
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
