"""Command ``taichi-mrf doctor``: look at some frames, and say which flag mends what is odd."""

import json
from pathlib import Path

import cv2
import numpy as np

from taichi_mrf.cli.options.doctor import Doctor
from taichi_mrf.cli.shared.terminal import READ_WRONG, Terminal
from taichi_mrf.datasets.doctor.diagnosis import Diagnosis
from taichi_mrf.datasets.doctor.picture import overlap
from taichi_mrf.datasets.doctor.remedy import Remedy, remedy
from taichi_mrf.datasets.registry import is_rendered
from taichi_mrf.errors import ConfigError
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import atomic_path


def run_doctor(options: Doctor) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    if options.picture is not None and options.picture.suffix.lower() != ".png":
        raise ConfigError(f"{options.picture}: --picture must end in .png")
    if is_rendered(options.source):
        runtime.init(options.arch)
    mended = remedy(options.source, options.poses, options.reading)
    found = mended.found
    drawn = options.picture is None or _write_picture(options.picture, found)
    if options.json:
        facts = {
            "findings": [{"text": each.text, "flag": each.flag} for each in found.findings],
            "undecided": found.undecided,
            "difference": found.before,
            "difference_mended": found.after,
            "contradicted": found.contradicted,
            "command": mended.command or None,
        }
        print(json.dumps(facts, indent=2))
    else:
        _print(Terminal(), mended)
        if not drawn:
            Terminal().print_line(f"{options.picture} is not written: no two frames overlap enough.")
    return READ_WRONG if found.findings or found.contradicted else 0


def _print(console: Terminal, mended: Remedy) -> None:
    found = mended.found
    for finding in found.findings:
        flag = f": {finding.flag}" if finding.flag else ""
        console.print_line(f"{finding.text}{flag}")
    if not found.findings and found.before is not None and not found.contradicted:
        console.print_line("Nothing odd was found.")
    if found.before is not None and found.after is not None:
        better = f", {found.after:.1%} once corrected" if found.after < found.before else ""
        console.print_line(f"Overlapping frames differ by {found.before:.1%} of depth as read{better}.")
    if found.undecided:
        console.print_line(f"The recording cannot tell {', '.join(found.undecided)}.")
    if mended.command:
        console.print_line(mended.command)


def _write_picture(path: Path, found: Diagnosis) -> bool:
    """False if there is nothing to draw."""
    picture = overlap(found)
    if picture is None:
        return False
    png = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1]
    with atomic_path(path) as temporary:
        temporary.write_bytes(png.tobytes())
    return True
