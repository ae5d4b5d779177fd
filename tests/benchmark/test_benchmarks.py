"""The scripts in benchmarks/ can be started; the one that measures a GPU runs through on a CPU."""

import importlib
import json
from pathlib import Path

import pytest
from new_interpreter import python

from benchmarks.lab.__main__ import EXPERIMENTS


def run(*arguments: str | Path, cwd: Path | None = None) -> str:
    done = python(*arguments, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_of_the_laboratory_is_there(name: str) -> None:
    module, _, function = EXPERIMENTS[name].function.partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_an_experiment_of_the_laboratory_runs(repository: Path, tmp_path: Path) -> None:
    command = ["-m", "benchmarks.lab", "endless", "--limit", "4", "--voxel-sizes", "0.2"]
    command += ["--data", str(tmp_path), "--out", str(tmp_path / "out"), "--runtime.arch", "cpu"]
    run(*command, cwd=repository)
    assert (tmp_path / "out" / "endless.csv").stat().st_size > 0


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


@pytest.mark.soak
def test_the_first_run_compiles_no_longer_than_before(repository: Path) -> None:
    run(
        repository / "benchmarks" / "first_run.py",
        "--gate", str(repository / "benchmarks" / "first_run.json"),
    )  # fmt: skip


def test_the_measurement_of_thin_things_runs(repository: Path, tmp_path: Path) -> None:
    out = tmp_path / "thin.json"
    command = ["-m", "benchmarks.thin", "--voxel-size", "0.1", "--method", "mrf", "log_odds"]
    command += ["--views", "6", "--held-out", "1", "--json", str(out), "--arch", "cpu"]
    run(*command, cwd=repository)
    mrf, log_odds = json.loads(out.read_text(encoding="utf-8"))
    assert (mrf["method"], log_odds["method"]) == ("mrf", "log_odds")
    assert mrf["precision"] > log_odds["precision"]
    assert {"leg", "post 2 cm", "post 4 cm", "post 6 cm", "cable", "wall"} <= set(mrf["kinds"])
    assert log_odds["kinds"]["post 6 cm"]["occupied"] > 0.8
