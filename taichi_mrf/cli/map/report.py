"""The report of a mapping run as a table on the terminal."""

from pathlib import Path
from typing import Any

from rich.table import Table

from taichi_mrf.cli.shared.terminal import Terminal


def print_report(console: Terminal, report: dict[str, Any], written: list[Path]) -> None:
    """The report as a table, then what should be known besides, then where the files lie."""
    table = Table(show_header=False, title=f"Map of {report['source']}", title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for name, text in _rows(report):
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


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
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
