"""``map --noise auto``: sigma from the recording, and the word about a noise that held-out frames doubt."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from console import FAST, taichi_mrf

from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.options.pose_flags import PoseFlags
from taichi_mrf.config.schema import load
from taichi_mrf.errors import ConfigError

ROOM = "synthetic:room?frames=12&width=160&height=120"
FLAGS = (*FAST, "--voxel-size", "0.03", "--evaluation.hold-out", "4")
TOO_SMALL = ("--sensor.sigma", "0.0003", "-0.0003", "0.00038")
"""A fifth of the simulated one."""


def report_of(folder: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return report


def test_a_wrong_noise_is_named_learnt_and_used_again(tmp_path: Path) -> None:
    wrong, auto, again = (tmp_path / name for name in ("wrong", "auto", "again"))
    done = taichi_mrf("map", ROOM, "--out", wrong, *FLAGS, *TOO_SMALL)
    assert done.returncode == 0, done.stderr
    noise = report_of(wrong)["noise"]
    assert noise["wrong"]
    assert noise["factor"] > 3
    assert any("--noise auto learns it" in note for note in report_of(wrong)["notes"])
    assert not (wrong / "sensor.yaml").exists()

    learn = ("map", ROOM, "--out", auto, *FLAGS, *TOO_SMALL, "--noise", "auto")
    done = taichi_mrf(*learn)
    assert done.returncode == 0, done.stderr
    report = report_of(auto)
    assert report["noise_from"] == "auto"
    assert not report["noise"]["wrong"]
    assert report["noise"]["learnt"]["factor"] > 3
    assert "learning noise" in report["seconds"]
    sensor = load(auto / "config.yaml").sensor
    assert (sensor.sigma_scale, sensor.sigma_added) != (1.0, 0.0)
    assert yaml.safe_load((auto / "sensor.yaml").read_text())["sensor"]["sigma_scale"] == sensor.sigma_scale
    assert "holds this run already" in taichi_mrf(*learn).stdout

    done = taichi_mrf("map", ROOM, "--out", again, *FLAGS, "--config", auto / "sensor.yaml")
    assert done.returncode == 0, done.stderr
    assert load(again / "config.yaml").sensor == sensor
    assert report_of(again)["accuracy"] == report["accuracy"]


def test_the_right_noise_is_not_blamed(tmp_path: Path) -> None:
    done = taichi_mrf("map", ROOM, "--out", tmp_path / "run", *FLAGS)
    assert done.returncode == 0, done.stderr
    noise = report_of(tmp_path / "run")["noise"]
    assert noise["frames"] == 3
    assert not noise["wrong"]
    assert not any("held-out frames differ" in note for note in report_of(tmp_path / "run")["notes"])


def test_noise_is_not_learnt_without_poses() -> None:
    with pytest.raises(ConfigError, match="--noise auto does not work with --track-poses"):
        Map(sources=("walk",), out=Path("run"), noise="auto", poses=PoseFlags(track_poses=True))
