"""``taichi-mrf live`` as a person runs it: two processes, their page, their files, and how they end."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import trimesh
from console import Done, as_process, assert_refused, complaints, mapped, taichi_mrf
from live_program import DEADLINE_S, PROGRAM, with_shortest_life
from new_interpreter import obey_hangups

from taichi_mrf.cli.parser import parse

ROOM = "synthetic:room?frames=6&width=80&height=60"
FLAGS = ("--voxel-size", "0.1", "--runtime.arch", "cpu", "--port", "0")
FILES = {"map.npz", "voxels.ply", "config.yaml", "report.json"}
PICTURES = {"surface.png", "top_view.png", "depth.png"}

linux_only = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs the list in /proc")


EVER_YOUNG = with_shortest_life(1e9)
"""No viewer has lived long enough to be started again, however slow the machine."""


def command(*arguments: str | Path, start: tuple[str, str] = PROGRAM) -> list[str]:
    return [sys.executable, *start, *map(str, arguments)]


class Running:
    """A live run whose page is up."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.process = process
        self.said: list[str] = []
        self.address = ""
        while not self.address:
            line = self._line()
            found = re.search(r"http://\S+", line)
            self.address = found.group() if found else ""

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, f"it ended: {self.process.stderr.read() if self.process.stderr else ''}"
        self.said.append(line)
        return line

    def children(self) -> list[int]:
        pid = self.process.pid
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]

    def viewer(self) -> int:
        """The process of the page."""
        (viewer,) = [pid for pid in self.children() if b"spawn_main" in cmdline(pid)]
        return viewer

    def wait(self) -> tuple[int, str]:
        """Exit status, and what was said on stderr."""
        output, errors = self.process.communicate(timeout=DEADLINE_S)
        self.said.append(output)
        return self.process.returncode, errors


def cmdline(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def is_running(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def wait_for_end(pid: int) -> None:
    while is_running(pid):
        time.sleep(0.05)


@contextmanager
def running(*arguments: str | Path, start: tuple[str, str] = PROGRAM) -> Iterator[Running]:
    """A live run that goes on until it is told to end, in a process group of its own."""
    with subprocess.Popen(
        command("live", *arguments, start=start),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=obey_hangups,
    ) as process:
        try:
            yield Running(process)
        finally:
            if process.poll() is None:
                process.kill()


def voxels(folder: Path) -> dict[tuple[float, ...], float]:
    cloud = trimesh.load(folder / "voxels.ply")
    occupancy = cloud.metadata["_ply_raw"]["vertex"]["data"]["occupancy"]
    return {tuple(c.tolist()): float(p) for c, p in zip(cloud.vertices, occupancy, strict=True)}


def read_report(folder: Path) -> dict[str, Any]:
    report = json.loads((folder / "report.json").read_text())
    assert isinstance(report, dict)
    return report


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Done]:
    """A run that ended by itself: its folder, and what it printed."""
    out = tmp_path_factory.mktemp("ended") / "live"
    return out, as_process("live", ROOM, "--exit-when-done", "--out", out, "--time.half-life-s", "0", *FLAGS)


def test_a_run_that_ends_by_itself_leaves_the_map_that_map_makes(
    tmp_path: Path, ended: tuple[Path, Done]
) -> None:
    out, done = ended
    assert (done.returncode, complaints(done.stderr)) == (0, "")
    assert re.search(r"The map is at http://127\.0\.0\.1:\d+ ", done.stdout)
    assert {path.name for path in out.iterdir()} == FILES | PICTURES
    mapped(ROOM, "--out", tmp_path / "batch", "--no-pictures", *FLAGS[:-2])
    live_report, batch_report = (read_report(folder) for folder in (out, tmp_path / "batch"))
    assert live_report.keys() == batch_report.keys()
    different = {key for key in live_report if live_report[key] != batch_report[key]}
    assert different <= {"seconds", "peak_memory_mb", "map_memory_mb"}
    assert voxels(out) == voxels(tmp_path / "batch")


@linux_only
@pytest.mark.parametrize(
    ("number", "whole_group"),
    [(signal.SIGINT, True), (signal.SIGTERM, False), (signal.SIGHUP, True)],
    ids=["ctrl-c", "kill", "closed terminal"],
)
def test_a_signal_ends_it_with_its_files_and_without_orphans(
    number: signal.Signals, whole_group: bool, tmp_path: Path
) -> None:
    with running(ROOM, "--out", tmp_path, *FLAGS) as run:
        assert urllib.request.urlopen(run.address).status == 200
        children = run.children()
        run.viewer()
        (os.killpg if whole_group else os.kill)(run.process.pid, number)
        status, errors = run.wait()
    assert (status, complaints(errors)) == (128 + number, "")
    assert {path.name for path in tmp_path.iterdir()} == FILES
    assert "Stopping" in run.said[-1]
    for child in children:
        wait_for_end(child)


@linux_only
def test_a_mapper_that_is_killed_takes_its_viewer_with_it() -> None:
    with running(ROOM, *FLAGS) as run:
        viewer = run.viewer()
        run.process.kill()
        run.wait()
        wait_for_end(viewer)


@linux_only
def test_a_viewer_that_is_killed_at_once_ends_the_run_but_not_its_map(tmp_path: Path) -> None:
    with running(ROOM, "--out", tmp_path, *FLAGS, start=EVER_YOUNG) as run:
        os.kill(run.viewer(), signal.SIGKILL)
        status, errors = run.wait()
    assert status == 2
    assert "the viewer's process has ended (exit status -9)" in errors
    assert complaints(errors).count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == FILES


def test_a_busy_port_is_told_with_the_one_that_was_taken() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        busy = other.getsockname()[1]
        # A process of its own: in this one the run may be over before the page is there.
        done = as_process("live", ROOM, "--limit", "1", "--exit-when-done", *FLAGS[:-1], str(busy))
    assert done.returncode == 0, done.stderr
    taken = re.search(rf"Port {busy} is busy, so the page took (\d+)\.", done.stdout)
    assert taken is not None, done.stdout
    assert f"http://127.0.0.1:{taken.group(1)} " in done.stdout


def test_a_page_for_everybody_is_warned_of(ended: tuple[Path, Done]) -> None:
    done = as_process("live", ROOM, "--limit", "1", "--exit-when-done", "--host", "0.0.0.0", *FLAGS)
    assert done.returncode == 0, done.stderr
    for words in ("Warning", "no password", "ssh -L"):
        assert words in done.stdout
    assert "Warning" not in ended[1].stdout


def test_the_folder_of_another_run_is_replaced_only_if_asked(tmp_path: Path) -> None:
    for name in ("map.npz", "top_view.png", "trajectory.txt"):
        (tmp_path / name).write_bytes(b"of another run")
    refused = taichi_mrf("live", ROOM, "--exit-when-done", "--out", tmp_path, *FLAGS)
    assert_refused(refused, f"{tmp_path}: holds a run: choose another --out, or add --overwrite")
    assert (tmp_path / "map.npz").read_bytes() == b"of another run"
    done = taichi_mrf(
        "live", ROOM, "--limit", "1", "--exit-when-done", "--out", tmp_path, "--overwrite", *FLAGS
    )
    assert (done.returncode, complaints(done.stderr)) == (0, "")
    assert {path.name for path in tmp_path.iterdir()} == FILES | PICTURES
    assert (tmp_path / "top_view.png").read_bytes() != b"of another run"


def test_a_saved_map_is_shown_with_its_own_parameters(tmp_path: Path, ended: tuple[Path, Done]) -> None:
    first, _ = ended
    again = taichi_mrf("live", first / "map.npz", "--exit-when-done", "--out", tmp_path / "again", *FLAGS[2:])
    assert (again.returncode, complaints(again.stderr)) == (0, "")
    assert "its own parameters are in force" in again.stdout
    assert voxels(tmp_path / "again") == voxels(first)
    assert "voxel_size: 0.1" in (tmp_path / "again" / "config.yaml").read_text()


def test_the_parameters_of_a_file_hold_unless_a_flag_says_otherwise(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("voxel_size: 0.2\ninference: {sweeps: 1, pass_through: 0.1}\n")
    flags = ("--config", str(tmp_path / "mine.yaml"), "--inference.sweeps", "2")
    settings = parse(["live", ROOM, *flags])[1].settings
    inference = settings.inference
    assert (settings.voxel_size, inference.sweeps, inference.pass_through) == (0.2, 2, 0.1)


@pytest.mark.parametrize(
    ("name", "text", "flags", "expected"),
    [
        ("live", None, (), 14400.0),
        ("live", "voxel_size: 0.2", (), 14400.0),
        ("live", "time: {moving_share: 0.01}", (), 14400.0),
        ("live", "time: {half_life_s: 0}", (), 0.0),
        ("live", "time: {half_life_s: 0}", ("--time.half-life-s", "5"), 5.0),
        ("live", None, ("--time.half-life-s", "0"), 0.0),
        ("map", None, (), 0.0),
        ("map", "voxel_size: 0.2", (), 0.0),
    ],
)
def test_the_world_of_a_live_run_changes_unless_a_file_or_a_flag_says_otherwise(
    name: str, text: str | None, flags: tuple[str, ...], expected: float, tmp_path: Path
) -> None:
    arguments = [name, ROOM, "--out", str(tmp_path), *flags]
    if text is not None:
        (tmp_path / "mine.yaml").write_text(text)
        arguments += ["--config", str(tmp_path / "mine.yaml")]
    _, options = parse(arguments)
    assert options.settings.time.half_life_s == expected


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["/no/such/folder"], ["/no/such/folder"]),
        (["synthetic:roon"], ["synthetic:roon", "synthetic:room"]),
        ([ROOM, "--speed", "-1"], ["--speed"]),
        ([ROOM, "--keep-live", "0"], ["--keep-live"]),
        ([ROOM, "--port", "70000"], ["--port"]),
        ([ROOM, "--host", "203.0.113.1"], ["203.0.113.1"]),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_bad_input_ends_in_one_line(arguments: list[str], words: list[str]) -> None:
    done = taichi_mrf("live", *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr


def test_a_damaged_map_is_named(tmp_path: Path) -> None:
    (tmp_path / "map.npz").write_bytes(b"not a map")
    done = taichi_mrf("live", tmp_path / "map.npz")
    assert_refused(done, str(tmp_path / "map.npz"))
