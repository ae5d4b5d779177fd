"""The console program as a process, and what its tests share."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from taichi_mrf.cli.parser import parse

ROOM = "synthetic:room?frames=12&width=160&height=120"


COARSE = ("--voxel-size", "0.1", "--runtime.arch", "cpu")


FAST = (*COARSE, "--no-pictures")


def taichi_mrf(
    *arguments: str | Path, options: tuple[str, ...] = (), before: Callable[[], None] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the program from the source tree; ``options`` are the interpreter's."""
    return subprocess.run(
        [sys.executable, *options, "-m", "taichi_mrf", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=before,
    )


def mapped(*arguments: str | Path) -> str:
    """Run ``map``, which must succeed without complaints; returns what it printed."""
    done = taichi_mrf("map", *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def report_of(out: Path) -> dict:
    return json.loads((out / "report.json").read_text(encoding="utf-8"))


def assert_refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    """Exit status 2, and one line on stderr with all these words."""
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr
    assert done.stdout == ""


def carry_out(*arguments: object) -> int:
    """Parse the arguments and run the command in this process; returns the exit status. Its exceptions reach
    the test."""
    command, options = parse([str(argument) for argument in arguments])
    return command.run(options)
