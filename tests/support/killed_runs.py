"""Runs of ``taichi-mrf map`` that are killed (SIGKILL) at a chosen step and resumed; and whether what they
leave is whole, and in the end what an undisturbed run leaves.

As a program it is ``taichi-mrf`` that tells each of its steps, by the stage's name in a line, on a pipe:
``python killed_runs.py FD map ...``.
"""

import hashlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import trimesh
from console import taichi_mrf

from taichi_mrf.config.schema import load
from taichi_mrf.methods.map_file import open_map_file, read_header

SOURCE = "synthetic:room?frames=10&width=80&height=60"
OPTIONS = ("--voxel-size", "0.1", "--runtime.arch", "cpu", "--no-pictures", "--keep-every", "0")
SAME = ("map.npz", "voxels.ply", "config.yaml")
LONGEST_DELAY_S = 0.03
"""A kill comes at most so long after a step: it may fall into the next one, or into a file's writing."""


@dataclass(frozen=True)
class Killed:
    """A kill: the stage it fell into, and the keyframes on disk after it."""

    stage: str
    keyframes: int


@dataclass
class Run:
    """A run in a folder, killed and resumed until it is through."""

    folder: Path
    options: tuple[str, ...] = ()
    kills: list[Killed] = field(default_factory=list)

    def go(self, kill_at: int | None = None, delay_s: float = 0.0) -> list[str]:
        """Start or resume it; kill it after so many steps, if it makes so many. One that is not to be killed
        runs in this process. Returns the stages of its steps. Raises AssertionError if it fails."""
        resume = () if not self.folder.exists() else ("--resume",)
        arguments = ("map", SOURCE, "--out", str(self.folder), *OPTIONS, *self.options, *resume)
        if kill_at is None:
            with told_steps() as told:
                done = taichi_mrf(*arguments)
            assert done.returncode == 0, done.stderr
            return told
        receive, send = os.pipe()
        command = [sys.executable, __file__, str(send), *arguments]
        with subprocess.Popen(
            command, pass_fds=[send], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process:
            os.close(send)
            stages: list[str] = []
            with open(receive, encoding="utf-8") as steps:
                for line in steps:
                    stages.append(line.strip())
                    if len(stages) == kill_at:
                        time.sleep(delay_s)
                        process.kill()
            said = process.stdout.read() if process.stdout else ""
        if process.returncode == -signal.SIGKILL:
            self.kills.append(Killed(stages[-1], keyframes_of(self.folder)))
        else:
            assert process.returncode == 0, said
        return stages

    @property
    def finished(self) -> bool:
        """True if its report says so."""
        path = self.folder / "report.json"
        return path.exists() and not json.loads(path.read_text(encoding="utf-8"))["interrupted"]

    def digests(self) -> dict[str, str]:
        """Files that it has left, by name."""
        return {name: hashlib.sha256((self.folder / name).read_bytes()).hexdigest() for name in SAME}


def keyframes_of(folder: Path) -> int:
    """How many keyframes a map on disk has, 0 without one. Each file that has its name must be whole."""
    found = 0
    for path in folder.iterdir() if folder.exists() else ():
        if path.name.startswith("."):  # half a file, which goes by no name that anybody looks for
            continue
        if path.suffix == ".npz":
            with open_map_file(path) as file:
                found = len(read_header(path, file).keyframes)
                assert all(len(file[name]) >= 0 for name in file.names if file.header(name)[0])
        elif path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"))
        elif path.suffix == ".yaml":
            load(path)
        else:
            assert path.suffix == ".ply", path
            # trimesh reads a file without points, which the visibility map may leave, as an empty scene.
            (claimed,) = re.findall(rb"element vertex (\d+)", path.read_bytes()[:1000])
            assert len(getattr(trimesh.load(path), "vertices", ())) == int(claimed)
    return found


def disturbed(folder: Path, draw: random.Random, steps: int, options: tuple[str, ...] = ()) -> Run:
    """A run that is killed up to three times at random steps, of about so many as an undisturbed one makes,
    and then resumed to its end, after which none of its temporary files is left."""
    run = Run(folder, options)
    for _ in range(draw.randint(1, 3)):
        run.go(draw.randint(1, steps), draw.uniform(0, LONGEST_DELAY_S))
    run.go()
    assert run.finished
    names = {path.name for path in folder.iterdir()}
    assert names == {*SAME, "report.json"}, names
    return run


@contextmanager
def told_steps(pipe: int | None = None) -> Iterator[list[str]]:
    """Have the program say each of its steps: in the list, or on a pipe."""
    from taichi_mrf.cli.map import keep
    from taichi_mrf.cli.shared.progress import ProgressBar

    told: list[str] = []

    def tell(stage: str) -> None:
        if pipe is None:
            told.append(stage)
        else:
            os.write(pipe, f"{stage}\n".encode())

    advance, write_text = ProgressBar.advance, keep.write_text

    def told_advance(self: ProgressBar, stage: str, *rest: int) -> None:
        tell(stage)
        advance(self, stage, *rest)

    def told_write(path: Path, text: str) -> None:
        tell("Keeping")
        write_text(path, text)

    with patch.object(ProgressBar, "advance", told_advance), patch.object(keep, "write_text", told_write):
        yield told


if __name__ == "__main__":
    os.set_inheritable(int(sys.argv[1]), False)
    from taichi_mrf.cli.main import main

    with told_steps(int(sys.argv[1])):
        sys.exit(main(sys.argv[2:]))
