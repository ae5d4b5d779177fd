"""The scripts in benchmarks/ work, on next to nothing: what they measure here is not looked at."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


def run(script: Path, *flags: str) -> str:
    done = subprocess.run([sys.executable, str(script), *flags], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.skipif(
    not any(shutil.which(name) for name in ("c++", "g++", "clang++")), reason="there is no C++ compiler here"
)
def test_the_walk_in_cpp_comes_to_the_sums_of_the_kernel(repository: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.json"
    run(
        repository / "benchmarks" / "walk.py",
        "--rays",
        "2000",
        "--bricks",
        "8",
        "--threads",
        "2",
        "--json",
        str(out),
    )
    (row,) = json.loads(out.read_text(encoding="utf-8"))
    assert row["agreement"] > 0.9999
    assert abs(row["steps"] - row["cpp_steps"]) < 0.001 * row["steps"]
    assert row["taichi_ns"] > 0
    assert row["cpp_ns"] > 0


def test_the_gpu_script_runs_through_on_a_cpu_and_says_so(repository: Path, tmp_path: Path) -> None:
    out = tmp_path / "gpu.json"
    text = run(repository / "benchmarks" / "gpu.py", "--arch", "cpu", "--quick", "--json", str(out))
    assert "This is no CUDA device" in text
    assert "device: cpu" in text
    report = json.loads(out.read_text(encoding="utf-8"))
    for part in ("tests", "kernels", "wall", "octomap"):
        assert "problem" not in report[part], report[part]
    coarse, fine = report["wall"]["rows"]
    assert "full_seconds" in fine
    assert "full_seconds" not in coarse
    assert fine["launches_in_a_sweep"] > 0
    assert fine["waits_in_a_sweep"] == 0  # on a CPU
    assert all(row["kernel_seconds"] > 0 and row["bandwidth_share"] > 0 for row in report["kernels"]["rows"])


def test_first_scores_come_before_full_ones(repository: Path) -> None:
    source = "synthetic:room?frames=6&width=64&height=48"
    script = repository / "benchmarks" / "first_scores.py"
    said = run(script, source, "--voxel-size", "0.2", "--tries", "1")
    assert "4 frames of 64 x 48 mapped at 20 cm, 2 judged" in said


def test_the_rates_of_balls_and_paths(repository: Path) -> None:
    said = run(repository / "benchmarks" / "within_rate.py", "--voxel-size", "0.2", "--queries", "100")
    assert said.count("a second") == 5


def test_a_drive_down_a_street(repository: Path) -> None:
    flags = ("--scans", "4", "--every", "2", "--voxel-size", "1", "--window-m", "2", "--arch", "cpu")
    said = run(repository / "benchmarks" / "lidar_drive.py", *flags)
    assert [row.split()[0] for row in said.splitlines()] == ["scans", "2", "4"]


def test_a_loop_is_closed(repository: Path) -> None:
    flags = ("--keyframes", "4", "--moved", "2", "--width", "32", "--height", "24", "--voxel-size", "0.4")
    said = run(repository / "benchmarks" / "loop_closure.py", *flags, "--no-rivals", "--arch", "cpu")
    assert "others swept again" in said
    assert "bit for bit the map made anew: True" in said
