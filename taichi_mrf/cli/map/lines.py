"""Output of ``taichi-mrf map``: the progress of a run, its result, and its exit status."""

import math
from pathlib import Path
from typing import Any

from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.shared.interrupt import StopRequest
from taichi_mrf.cli.shared.print_table import print_facts
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.terminal import DID_NOT_FIT, READ_WRONG, Terminal, print_problem
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.pipeline import Event, FrameOffered, Listener, WaitingForPoses
from taichi_mrf.mapping.rounds import RoundStep
from taichi_mrf.session.files import MAP_FILE, VOXEL_FILE
from taichi_mrf.session.report import report_json

OPEN_VOXELS = "Look at the .png files, or open voxels.ply in MeshLab, CloudCompare or Blender. "
KEPT = "The files are kept; --force suppresses this error."
LIVE_VIEW = "shows the map in the browser."


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


def print_finished(console: Terminal, options: Map, report: dict[str, Any]) -> None:
    """Print that the folder holds this very run already."""
    if options.json:
        print(report_json(report), end="")
    console.print_line(f"{options.out} already holds this run, finished; --overwrite maps it again.")


def exit_status(options: Map, report: dict[str, Any], request: StopRequest) -> int:
    """The exit status of a run in this process; one that is not 0 without a ``request`` to stop is explained
    on stderr."""
    if not request() and report["refused"] and not options.force:
        print_problem(f"{report['refused']} {KEPT}")
        return READ_WRONG
    if request() or report["did_not_fit"] is None:
        return request.exit_status
    saved = f"the map of {report['keyframes']} keyframes was saved to {options.out}"
    print_problem(f"{report['did_not_fit']}; {saved}; --resume continues it")
    return DID_NOT_FIT


def print_run(console: Terminal, options: Map, report: dict[str, Any], written: list[Path]) -> None:
    """Print the result of one source."""
    if options.json:
        print(report_json(report), end="")
        return
    if not options.force:  # it is the error that the command ends with
        report = {**report, "notes": [note for note in report["notes"] if note != report["refused"]]}
    print_report(console, report, written)
    look = OPEN_VOXELS if any(path.name == VOXEL_FILE for path in written) else ""
    if not any(path.suffix == ".png" for path in written):
        look = look.replace("Look at the .png files, or open", "Open")
    console.print(f"{look}taichi-mrf live {options.out / MAP_FILE} {LIVE_VIEW}")


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
        ("frames", f"{report['frames']}, {_keyframes_text(report)}"),
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


def _keyframes_text(report: dict[str, Any]) -> str:
    frozen, before = report["frozen"], report["keyframes_before"]
    count = report["keyframes"] + frozen - before
    if before:
        return f"{count} of them keyframes, which join {before} of the earlier map"
    return f"{count} of them keyframes" + (f", {frozen} frozen outside of the window" if frozen else "")


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
