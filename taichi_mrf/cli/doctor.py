"""Command ``taichi-mrf doctor``: look at some frames, and say which flag mends what is odd."""

import json
import shlex
from pathlib import Path

import cv2
import numpy as np

from taichi_mrf.cli.options.doctor import Doctor
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.datasets.conventions import AXIAL, conventions_of
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.registry import is_rendered
from taichi_mrf.doctor.diagnosis import Diagnosis, diagnose
from taichi_mrf.doctor.picture import overlap
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import atomic_path

SOMETHING_TO_MEND = 4
"""Exit status for a recording that is not read as it was written."""


def run_doctor(options: Doctor) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    if options.picture is not None and options.picture.suffix.lower() != ".png":
        raise ConfigError(f"{options.picture}: --picture must end in .png")
    if is_rendered(options.source):
        runtime.init(options.arch)
    reading = options.reading.keywords()
    said = conventions_of(reading["poses_are"], reading["mounting"], reading["depth_is"])
    as_written = {**reading, "poses_are": None, "mounting": None, "depth_is": AXIAL}
    try:
        dataset = open_posed(options.source, options.poses, color=False, **as_written)
    except DatasetError:  # such as scans that are only read with the flag that their poses want
        if as_written == reading:
            raise
        dataset = open_posed(options.source, options.poses, color=False, **reading)
    found = diagnose(dataset, said)
    drawn = options.picture is None or _write_picture(options.picture, found)
    if options.json:
        facts = {
            "findings": [{"text": each.text, "flag": each.flag} for each in found.findings],
            "undecided": found.undecided,
            "difference": found.before,
            "difference_mended": found.after,
        }
        print(json.dumps(facts, indent=2))
    else:
        _print(Terminal(), found, options)
        if not drawn:
            Terminal().print_line(f"{options.picture} is not written: no two frames overlap enough.")
    return SOMETHING_TO_MEND if found.findings else 0


def _print(console: Terminal, found: Diagnosis, options: Doctor) -> None:
    for finding in found.findings:
        flag = f": {finding.flag}" if finding.flag else ""
        console.print_line(f"{finding.text}{flag}")
    if not found.findings and found.before is not None:
        console.print_line("Nothing odd was found.")
    if found.before is not None and found.after is not None:
        mended = f", {found.after:.1%} once corrected" if found.after < found.before else ""
        console.print_line(f"Overlapping frames differ by {found.before:.1%} of depth as read{mended}.")
    if found.undecided:
        console.print_line(f"The recording cannot tell {', '.join(found.undecided)}.")
    flags = dict.fromkeys(each.flag for each in found.findings if each.flag)
    if flags:
        names = {flag.split()[0] for flag in flags}
        said = [word for word in options.reading.words() if word.split("=")[0] not in names]
        said += [f"--poses={options.poses}"] if options.poses else []
        words = [shlex.join(["taichi-mrf", "map", options.source, *said]), *flags, "--out DIR"]
        console.print_line(" ".join(words))


def _write_picture(path: Path, found: Diagnosis) -> bool:
    """False if there is nothing to draw."""
    picture = overlap(found)
    if picture is None:
        return False
    png = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1]
    with atomic_path(path) as temporary:
        temporary.write_bytes(png.tobytes())
    return True
