"""What a mapping run tells at its end: the contents of ``report.json``, and the same as a table."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import taichi_mrf
from taichi_mrf.datasets import Dataset
from taichi_mrf.evaluation.held_out import HeldOutCheck
from taichi_mrf.mapping.refinement import PoseChange
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.mapping.tracking import Track
from taichi_mrf.system import runtime
from taichi_mrf.system.memory import peak_memory_mb

_REFINED_NOTE = "Accuracy is that of the held-out frames at their recorded poses, which were not refined."
_TRACKED_NOTE = "Accuracy is that of the held-out frames where tracking found them: it does not show drift."


def run_report(
    result: MappingResult, dataset: Dataset, source: str, check: HeldOutCheck | None
) -> dict[str, Any]:
    """The facts of a run as plain values, lengths in metres; ``accuracy`` is None without held-out frames,
    and ``did_not_fit`` None unless there was too little memory."""
    statistics = result.map.statistics()
    choice = runtime.choice()
    return {
        "source": source,
        "method": result.map.config.method,
        "version": taichi_mrf.__version__,
        "backend": choice.name if choice else None,
        "device": choice.device if choice else None,
        "interrupted": result.interrupted or result.full is not None,
        "did_not_fit": result.full,
        "frames": result.frames,
        "keyframes": len(result.map.keyframes),
        "rays": sum(keyframe.rays for keyframe in result.map.keyframes.values()),
        "voxel_size": result.map.voxel_size,
        "bricks": statistics.bricks,
        "voxels": statistics.voxels,
        "map_memory_mb": round(statistics.memory_mb, 3),
        "peak_memory_mb": peak_memory_mb(),
        "sweeps": result.sweeps,
        "residual": result.residual,
        "seconds": rounded(result.seconds),
        "accuracy": None if check is None else {"frames": check.frames, **dataclasses.asdict(check.error)},
        "tracking": None if result.track is None else _tracking(result.track),
        "poses": [_pose_report(change) for change in result.poses],
        "skipped_frames": result.skipped,
        "dropped_frames": dataset.dropped,
        "notes": [*dataset.notes, *_pose_notes(result, check is not None)],
    }


def rounded(seconds: dict[str, float]) -> dict[str, float]:
    """The seconds of each stage, to milliseconds."""
    return {stage: round(value, 3) for stage, value in seconds.items()}


def _tracking(track: Track) -> dict[str, int]:
    return {"frames": len(track.frames), "lost": track.lost, "unsure": track.unsure}


def unfinished_report(
    result: MappingResult, dataset: Dataset, source: str, skipped: dict[str, str]
) -> dict[str, Any]:
    """The facts of a run that goes on, for whoever finds its files after a crash; ``skipped`` are the broken
    frames that the run before has met."""
    report = run_report(result, dataset, source, None)
    return {**report, "interrupted": True, "skipped_frames": skipped | report["skipped_frames"]}


def _pose_report(change: PoseChange) -> dict[str, Any]:
    return {
        "keyframe": change.name,
        "moved_m": round(change.translation_m, 6),
        "turned_rad": round(change.rotation_rad, 6),
        "T_recorded": change.T_recorded.tolist(),
        "T_refined": change.T_refined.tolist(),
    }


def _pose_notes(result: MappingResult, checked: bool) -> list[str]:
    """What accuracy says where poses are not those of the recording."""
    if not checked:
        return []
    if result.track is not None:
        return [_TRACKED_NOTE]
    return [_REFINED_NOTE] if result.poses else []


def report_json(report: dict[str, Any]) -> str:
    """The report as JSON text, in which numbers that are not finite are null."""
    return json.dumps(_finite(report), indent=2) + "\n"


def print_report(console: Console, report: dict[str, Any], written: list[Path]) -> None:
    """The report as a table, then what should be known besides, then where the files lie."""
    table = Table(show_header=False, title=f"Map of {report['source']}", title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for name, text in _rows(report):
        table.add_row(name, text)
    console.print(table)
    for note in report["notes"]:
        console.print(f"Note: {note}", markup=False, soft_wrap=True)
    for problem in report["skipped_frames"].values():
        console.print(f"Skipped: {problem}", markup=False, soft_wrap=True)
    if report["interrupted"]:
        console.print("[yellow]Stopped before the end; --resume goes on from here.[/]")
    for path in written:
        console.print(str(path), markup=False, highlight=False, soft_wrap=True)


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    seconds = ", ".join(f"{stage} {value:.1f}" for stage, value in report["seconds"].items())
    peak = report["peak_memory_mb"]
    tracking = report["tracking"]
    return [
        ("backend", f"{report['backend']} ({report['device']})"),
        ("method", report["method"]),
        ("frames", f"{report['frames']}, {report['keyframes']} of them keyframes"),
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


def _tracking_text(tracking: dict[str, int]) -> str:
    text = f"{tracking['frames']} frames found, {tracking['lost']} lost"
    return text + (f", {tracking['unsure']} where depth told too little" if tracking["unsure"] else "")


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


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
