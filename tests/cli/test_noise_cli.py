"""``--noise auto`` of map, live and tune: sigma from the recording, and the word about a noise that held-out
frames doubt."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from console import COARSE, FAST, assert_refused, mapped, report_of, taichi_mrf

from taichi_mrf.calibration.from_recording import LearntSigma
from taichi_mrf.cli.map import reading
from taichi_mrf.cli.options.live import Live
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.options.shared import NoiseFlags, PoseFlags
from taichi_mrf.cli.shared import learn_noise
from taichi_mrf.config.schema import load
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.noise_fit import SigmaLaw
from taichi_mrf.session import folder
from taichi_mrf.tune.working_set import read_working_set
from taichi_mrf.viewer.tune.messages import FrameChoice

ROOM = "synthetic:room?frames=12&width=80&height=60"
FINE = ("--voxel-size", "0.05", "--runtime.arch", "cpu")
FLAGS = (*FINE, "--no-pictures", "--evaluation.hold-out", "4")
TOO_SMALL = ("--sensor.sigma", "0.0003", "-0.0003", "0.00038")
"""A fifth of the simulated one."""


LEARN = (*FLAGS, *TOO_SMALL, "--noise", "auto")


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that learns."""
    out = tmp_path_factory.mktemp("learnt")
    mapped(ROOM, "--out", out, *LEARN)
    return out


def test_a_wrong_noise_is_named(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong"
    done = taichi_mrf("map", ROOM, "--out", wrong, *FLAGS, *TOO_SMALL)
    assert done.returncode == 0, done.stderr
    noise = report_of(wrong)["noise"]
    assert noise["wrong"]
    assert noise["factor"] > 3
    assert any("--noise auto learns it" in note for note in report_of(wrong)["notes"])
    assert not (wrong / "sensor.yaml").exists()


def test_a_noise_is_learnt_and_used_again(tmp_path: Path, learnt: Path) -> None:
    again = tmp_path / "again"
    report = report_of(learnt)
    assert report["noise_from"] == "auto"
    assert not report["noise"]["wrong"]
    assert report["noise"]["learnt"]["factor"] > 3
    assert "learning noise" in report["seconds"]
    sensor = load(learnt / "config.yaml").sensor
    assert (sensor.sigma_scale, sensor.sigma_added) != (1.0, 0.0)
    assert yaml.safe_load((learnt / "sensor.yaml").read_text())["sensor"]["sigma_scale"] == sensor.sigma_scale
    assert "already holds this run" in mapped(ROOM, "--out", learnt, *LEARN)

    done = taichi_mrf("map", ROOM, "--out", again, *FLAGS, "--config", learnt / "sensor.yaml")
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


def noise_in(path: Path) -> Any:
    """The parameters of a file with the learnt noise."""
    return yaml.safe_load(path.read_text())["sensor"]


def test_live_learns_what_map_learns(tmp_path: Path, learnt: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a static world, as map's is."""
    monkeypatch.setattr(folder, "write_pictures", lambda *_: [])  # which say nothing of noise
    flags = (*FINE, "--evaluation.hold-out", "4", "--time.half-life-s", "0", *TOO_SMALL, "--noise", "auto")
    done = taichi_mrf("live", ROOM, "--out", tmp_path / "live", "--exit-when-done", "--port", "0", *flags)
    assert done.returncode == 0, done.stderr
    assert "The noise of depth was learnt from" in done.stdout
    noise = noise_in(tmp_path / "live" / "sensor.yaml")
    assert noise == noise_in(learnt / "sensor.yaml")
    assert (noise["sigma_scale"], noise["sigma_added"]) != (1.0, 0.0)
    used = load(tmp_path / "live" / "config.yaml").sensor
    assert (used.sigma_scale, used.sigma_added) == (noise["sigma_scale"], noise["sigma_added"])
    report = report_of(tmp_path / "live")
    assert report["noise_from"] == "auto"
    assert report["noise"]["learnt"] == report_of(learnt)["noise"]["learnt"]


def test_tune_begins_with_what_it_learns(tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    done = taichi_mrf(
        "tune", ROOM, "--no-viewer", "--auto", "1", "--search", "sensor.sigma_scale", "--out", tmp_path,
        "--noise", "auto", *FINE, *TOO_SMALL,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "The noise of depth was learnt from" in done.stdout
    learnt = noise_in(tmp_path / "sensor.yaml")
    assert learnt["sigma_scale"] > 1.0 or learnt["sigma_added"] > 0.0
    first = load(tmp_path / "best.yaml").sensor
    assert (first.sigma_scale, first.sigma_added) == (learnt["sigma_scale"], learnt["sigma_added"])


def test_tune_learns_from_no_frame_that_scores_a_map(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def learn(dataset: Dataset, *_: object) -> None:
        asked.extend(dataset.frame_names)
        raise ConfigError("that is enough")

    monkeypatch.setattr(learn_noise, "learn_noise", learn)
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    done = taichi_mrf("tune", ROOM, "--no-viewer", "--auto", "1", "--frames", "9", "--noise", "auto", *COARSE)
    assert_refused(done, "that is enough")
    frames = read_working_set(open_dataset(ROOM), FrameChoice(0, 0, 9, 3), keep_unseen=True)
    scoring = {frame.name for frame in (*frames.held_out, *frames.unseen)}
    assert len(scoring) == 3
    assert sorted(asked) == sorted(set(open_dataset(ROOM).frame_names) - scoring)


def test_a_default_noise_that_is_doubted_is_learnt_unless_it_is_given(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    learnt = LearntSigma(SigmaLaw(1.5, 0.01), 4, 4000, 1.8, 0.1, 0.2, seconds=2.5)
    monkeypatch.setattr(reading, "sigma_of_glance", lambda *_, **__: learnt)
    learns, given = tmp_path / "learns", ("--noise", "given")
    for out, flags in ((learns, ()), (tmp_path / "given", given)):
        done = taichi_mrf("map", ROOM, "--out", out, "--limit", "3", *FAST, *flags)
        assert done.returncode == 0, done.stderr
    assert load(learns / "config.yaml").sensor.sigma_scale == 1.5
    notes = [note for note in report_of(learns)["notes"] if note.startswith("The noise of depth was learnt")]
    assert len(notes) == 1
    assert "in 2.5 s" in notes[0]
    assert load(tmp_path / "given" / "config.yaml").sensor.sigma_scale == 1.0
    assert "noise_from" not in report_of(learns)
    assert report_of(tmp_path / "given")["noise_from"] == "given"
    same = taichi_mrf("map", ROOM, "--out", learns, "--limit", "3", *FAST)
    assert "already holds this run" in same.stdout
    other = taichi_mrf("map", ROOM, "--out", learns, "--limit", "3", *FAST, *given)
    assert_refused(other, "noise_from")


def test_noise_is_not_learnt_without_poses() -> None:
    auto, tracking = NoiseFlags("auto"), PoseFlags(track_poses=True)
    with pytest.raises(ConfigError, match="--noise auto does not work with --track-poses: learn"):
        Map(sources=("walk",), out=Path("run"), noise=auto, poses=tracking)
    with pytest.raises(ConfigError, match="--noise auto does not work with --track-poses or --submap-size"):
        Map(sources=("walk",), out=Path("run"), noise=auto, poses=tracking, submap_size=4.0)
    with pytest.raises(ConfigError, match="--noise auto does not work with --track-poses"):
        Live(noise=auto, poses=tracking)


def test_a_saved_map_keeps_its_noise(tmp_path: Path) -> None:
    done = taichi_mrf("map", ROOM, "--out", tmp_path, "--limit", "2", *FAST)
    assert done.returncode == 0, done.stderr
    done = taichi_mrf("live", tmp_path / "map.npz", "--noise", "auto", "--port", "0", "--runtime.arch", "cpu")
    assert done.returncode == 2
    assert "map.npz: is a saved map, which keeps its noise: --noise auto is for a recording" in done.stderr
