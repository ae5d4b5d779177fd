"""``taichi-mrf map`` with several sequences: the files of single runs, whatever dies, and a summary."""

import csv
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from cluster_dask import dask_cluster
from console import as_process

from taichi_mrf.cli.main import main
from taichi_mrf.cli.map.summary import summary_line, summary_row
from taichi_mrf.cli.map.task import Outcome

SOURCES = tuple(f"synthetic:room?frames={frames}&width=80&height=60" for frames in (3, 4))
NAMES = tuple(f"synthetic_room_frames_{frames}_width_80_height_60" for frames in (3, 4))
COARSE = ("--voxel-size", "0.1", "--runtime.arch", "cpu")
FAST = (*COARSE, "--no-pictures")
OF_THE_RUN = {"seconds", "peak_memory_mb"}
"""Entries of a report on the run, not on the map."""


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "taichi_mrf", "map", *map(str, arguments)]


def taichi_mrf(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    return as_process("map", *arguments)


def results(folder: Path) -> dict[str, Any]:
    """All that a run has found out: the arrays of the map, the bytes of the voxels, the report."""
    with np.load(folder / "map.npz") as arrays:
        found: dict[str, Any] = {name: (a.dtype.str, a.shape, a.tobytes()) for name, a in arrays.items()}
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    found["report"] = {key: value for key, value in report.items() if key not in OF_THE_RUN}
    return found | {name: (folder / name).read_bytes() for name in ("voxels.ply", "config.yaml")}


def summary(out: Path) -> list[dict[str, Any]]:
    return json.loads((out / "summary.json").read_text(encoding="utf-8"))["sequences"]


def assert_all_are_there_once(out: Path, single: dict[str, dict[str, Any]]) -> None:
    """The results of single runs, one row for each, and nothing else in the folder."""
    rows = summary(out)
    assert [row["source"] for row in rows] == list(SOURCES)
    assert [row["name"] for row in rows] == list(NAMES)
    assert {path.name for path in out.iterdir() if path.is_dir()} == {row["name"] for row in rows}
    assert not list(out.glob("*/.*"))
    for row in rows:
        assert results(out / row["name"]) == single[row["source"]]


def wait_for(what: Callable[[], Any], program: "subprocess.Popen[str]") -> Any:
    """Its answer as soon as that is true, while the program runs."""
    while not (found := what()):
        assert program.poll() is None, program.communicate()
        time.sleep(0.02)
    return found


def child_in_the_middle(parent: int, out: Path, program: "subprocess.Popen[str]") -> psutil.Process:
    """A process that maps, which is held where it is so that it cannot finish before somebody is killed."""
    wait_for(lambda: out.is_dir() and any(path.is_dir() for path in out.iterdir()), program)
    child = wait_for(psutil.Process(parent).children, program)[0]
    child.send_signal(signal.SIGSTOP)
    return child


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Maps of the sources by runs of their own."""
    found = {}
    for source in SOURCES:
        out = tmp_path_factory.mktemp("single")
        done = taichi_mrf(source, "--out", out, *FAST)
        assert done.returncode == 0, done.stderr
        found[source] = results(out)
    return found


def test_a_killed_process_changes_nothing(tmp_path: Path, single: dict[str, dict[str, Any]]) -> None:
    arguments = command(*SOURCES, "--out", tmp_path, "--jobs", "2", "--json", *FAST)
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        child_in_the_middle(program.pid, tmp_path, program).kill()
        stdout, stderr = program.communicate()
    assert program.returncode == 0, stderr
    assert_all_are_there_once(tmp_path, single)
    assert json.loads(stdout)["sequences"] == summary(tmp_path)
    assert [row["status"] for row in summary(tmp_path)] == ["mapped"] * len(SOURCES)
    assert sum(": mapped, " in line for line in stderr.splitlines()) == len(SOURCES)


def test_a_killed_dask_worker_changes_nothing(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, single: dict[str, dict[str, Any]]
) -> None:
    with dask_cluster(tmp_path_factory.mktemp("dask"), 2) as cluster:
        arguments = command(*SOURCES, "--out", tmp_path, "--scheduler", cluster.address, *FAST)
        with subprocess.Popen(
            arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as program:
            worker = cluster.workers[0].pid
            child = child_in_the_middle(worker, tmp_path, program)
            cluster.workers[0].kill()
            child.send_signal(signal.SIGCONT)  # it notices that it is an orphan
            stdout, stderr = program.communicate()
    assert program.returncode == 0, stderr
    assert stderr == ""
    assert_all_are_there_once(tmp_path, single)
    assert sum(": mapped, " in line for line in stdout.splitlines()) == len(SOURCES)
    child.wait()


def test_what_is_finished_is_kept(tmp_path: Path, single: dict[str, dict[str, Any]]) -> None:
    arguments = command(*SOURCES, "--out", tmp_path, *FAST)
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert NAMES[0] in program.stdout.readline()
        program.send_signal(signal.SIGTERM)
        _, stderr = program.communicate()
    assert program.returncode == 128 + signal.SIGTERM, stderr
    assert stderr == ""
    first, second = summary(tmp_path)
    assert first["status"] == "mapped"
    assert second["status"] in ("stopped", "not done")
    written = (tmp_path / NAMES[0] / "report.json").stat().st_mtime_ns

    (tmp_path / NAMES[1]).mkdir(exist_ok=True)
    leftover = f".map.part-{program.pid}-0123abcd.npz"
    (tmp_path / NAMES[1] / leftover).touch()  # as if it had been killed while it wrote
    # Without --voxel-size: the parameters are those of the run that is resumed.
    done = taichi_mrf(*SOURCES, "--out", tmp_path, "--resume", "--no-pictures")
    assert done.returncode == 0, done.stderr
    assert_all_are_there_once(tmp_path, single)
    assert [row["status"] for row in summary(tmp_path)] == ["finished before", "mapped"]
    assert (tmp_path / NAMES[0] / "report.json").stat().st_mtime_ns == written


def test_a_sequence_that_fails_is_named_and_the_others_are_finished(tmp_path: Path) -> None:
    out, held_out = tmp_path / "out", ("--evaluation.hold-out", "3")
    broken = tmp_path / "broken"
    broken.mkdir()
    done = taichi_mrf(broken, SOURCES[0], "--out", out, "--jobs", "2", *held_out, *COARSE)
    assert done.returncode == 2
    assert done.stderr.startswith("taichi-mrf: 1 of 2 sequences failed, the first: broken: ")
    assert done.stderr.count("\n") == 1
    failed, mapped = summary(out)
    assert (failed["status"], mapped["status"]) == ("failed", "mapped")
    assert "the folder is empty" in failed["error"]
    assert mapped["median_abs"] < 0.1
    with (out / "summary.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["broken", "synthetic_room"]
    assert rows[0]["error"] == failed["error"]
    assert float(rows[1]["voxels"]) == mapped["voxels"]
    assert {path.name for path in out.iterdir()} == {
        "synthetic_room", "config.yaml", "summary.csv", "summary.json", "summary.png",
    }  # fmt: skip
    picture = cv2.imread(str(out / "summary.png"))
    left, right = np.array_split(picture, 2, axis=1)
    assert colors(left) < 0.01 < 0.2 < colors(right)  # a line of text beside a map


def test_a_resumed_batch_with_other_parameters_is_refused_and_forgets_nothing(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("voxel_size: 0.1\n")
    done = taichi_mrf(*SOURCES, "--out", tmp_path, "--resume", "--voxel-size", "0.2")
    assert done.returncode == 2
    assert "config.yaml: made with another voxel_size" in done.stderr
    assert (tmp_path / "config.yaml").read_text() == "voxel_size: 0.1\n"


def test_a_sequence_that_did_not_fit_says_so_in_the_summary() -> None:
    report = {
        "frames": 9, "keyframes": 4, "voxel_size": 0.1, "voxels": 512, "map_memory_mb": 1.0,
        "peak_memory_mb": None, "accuracy": None, "seconds": {"adding": 2.0},
    }  # fmt: skip
    row = summary_row("a", "a.bag", Outcome("failed", report, "frame 5 does not fit"))
    assert (row.error, row.keyframes) == ("frame 5 does not fit", 4)
    assert summary_line(row).endswith("2.0 s: frame 5 does not fit")


def colors(picture: np.ndarray) -> float:
    """The share of pixels that are not grey."""
    return float((np.ptp(picture.astype(int), axis=2) > 30).mean())


def test_one_sequence_on_a_cluster_is_like_one_here(
    tmp_path: Path, single: dict[str, dict[str, Any]]
) -> None:
    done = taichi_mrf(SOURCES[0], "--out", tmp_path, "--scheduler", "local", *FAST)
    assert (done.returncode, done.stderr) == (0, "")
    assert {path.name for path in tmp_path.iterdir()} == {
        "map.npz", "voxels.ply", "config.yaml", "report.json",
    }  # fmt: skip
    assert results(tmp_path) == single[SOURCES[0]]


def test_without_dask_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["map", *SOURCES, "--out", str(tmp_path / "out"), "--scheduler", "local"]) == 2
    assert capsys.readouterr().err == (
        "taichi-mrf: tasks on a cluster need distributed, which is not installed: "
        "pip install 'taichi-mrf[cluster]'\n"
    )
    assert not (tmp_path / "out").exists()
