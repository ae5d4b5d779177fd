"""``taichi-mrf eval`` as a person runs it, and maps of the other methods: processes, files, words, status."""

import csv
import json
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from console import (
    FAST,
    ROOM,
    as_process,
    assert_refused,
    complaints,
    mapped,
    report_of,
    signalled,
    taichi_mrf,
)
from small_scenes import make_data, make_redwood

from taichi_mrf.evaluation.experiments.table3 import PAPER
from taichi_mrf.evaluation.tables import entry_text
from taichi_mrf.methods.registry import load_map
from taichi_mrf.system import runtime

FILES = {"table3.csv", "table3.tex", "table3.png", "table3.jsonl", "table3_config.yaml"}
CPU = ("--runtime.arch", "cpu")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made on the CPU: the other backends' runs leave these tests out, to which they would add only time."""
    runtime.init("cpu")
    return make_data(tmp_path_factory.mktemp("data"))


def evaluated(data: Path, out: Path, *arguments: str) -> str:
    """Run ``eval``, which must succeed without complaints; returns what it printed."""
    done = taichi_mrf("eval", *arguments, "--data", data, "--out", out, *CPU)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def table3(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run of Table III: its folder, and what it printed."""
    out = tmp_path_factory.mktemp("table3") / "deep" / "out"
    return out, evaluated(data, out, "table3", "--voxel-sizes", "0.2", "0.05", "--seeds", "0")


def rows_of(out: Path) -> list[dict[str, str]]:
    with open(out / "table3.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_the_table_is_printed_beside_the_papers(table3: tuple[Path, str]) -> None:
    out, printed = table3
    assert {path.name for path in out.iterdir()} == FILES
    lines = printed.splitlines()
    for row in rows_of(out):
        # Piped, a row is a line, with the digits of the table.
        (line,) = (each for each in lines if row["voxels"] in each and f" {row['map']} " in each)
        assert f"{float(row['5cm']):.3f} ± {float(row['5cm (std)']):.3f}" in line
        if (row["map"], row["voxels"]) == ("MRFMap, omega", "5 cm"):
            assert entry_text(PAPER["MRFMap, omega", 0.05], 3) in line
    assert len(rows_of(out)) == 2 * (2 + 4 * 2)
    for words in (
        "Table III",
        "paper",
        "sensor's own noise",
        *(str(out / name) for name in FILES - {"table3.jsonl"}),
    ):
        assert words in printed
    assert cv2.imread(str(out / "table3.png")) is not None


def test_how_it_was_run_is_written_down(table3: tuple[Path, str]) -> None:
    written = yaml.safe_load((table3[0] / "table3_config.yaml").read_text())
    assert written["evaluation"]["experiment"] == "table3"
    assert written["evaluation"]["voxel_sizes"] == [0.2, 0.05]
    assert written["evaluation"]["seeds"] == [0]
    assert written["maps"]["inference"]["sweeps"] == 3


def test_a_second_run_computes_nothing_and_says_the_same(table3: tuple[Path, str], data: Path) -> None:
    out, printed = table3
    before = {name: (out / name).read_bytes() for name in FILES - {"table3.png"}}
    again = evaluated(data, out, "table3", "--voxel-sizes", "0.2", "0.05", "--seeds", "0")
    assert again == printed
    # Build times are in the table and in the ledger: computed once more they would differ.
    assert {name: (out / name).read_bytes() for name in before} == before


def test_ctrl_c_keeps_what_was_found(table3: tuple[Path, str], data: Path, tmp_path: Path) -> None:
    command = ("eval", "table3", "--data", data, "--out", tmp_path, "--voxel-sizes", "0.2", "0.05")
    ledger = tmp_path / "table3.jsonl"
    with signalled(signal.SIGINT, "table3", step=2):
        done = taichi_mrf(*command, "--seeds", "0", *CPU)
    assert (done.returncode, complaints(done.stderr)) == (130, "")
    assert "the same command continues from here" in " ".join(done.stdout.split())
    kept = ledger.read_text()
    assert 1 <= kept.count("\n") - 1 < (table3[0] / "table3.jsonl").read_text().count("\n") - 1
    assert not (tmp_path / "table3.csv").exists()
    evaluated(data, tmp_path, "table3", "--voxel-sizes", "0.2", "0.05", "--seeds", "0")
    assert ledger.read_text().startswith(kept)
    assert {path.name for path in tmp_path.iterdir()} == FILES
    for row, whole in zip(rows_of(tmp_path), rows_of(table3[0]), strict=True):
        assert {**row, "map (s)": ""} == {**whole, "map (s)": ""}


def test_table2_of_a_redwood_folder_maps_its_noise_and_judges_by_its_clean_depth(tmp_path: Path) -> None:
    runtime.init("cpu")
    room = make_redwood(tmp_path / "livingroom1")
    command = ("eval", "table2", "--data", room, "--voxel-sizes", "0.1", "--seeds", "0", *CPU)
    done = as_process(*command, "--out", tmp_path / "noisy")
    assert (done.returncode, complaints(done.stderr)) == (0, "")
    said = " ".join(done.stdout.split())
    # Turned by .3 radians from view to view: the paper's threshold, 1, takes the first and the fifth.
    assert "livingroom1 with the measurements in depth_noisy/, 2 keyframes of 5 views" in said
    assert {path.stem for path in (tmp_path / "noisy").glob("*.csv")} == {"table2", "table2_held_out"}

    def right(out: str) -> float:
        with open(tmp_path / out / "table2.csv", newline="") as file:
            return next(float(row["1.5sigma"]) for row in csv.DictReader(file) if row["map"] == "MRFMap")

    shutil.rmtree(room / "depth_noisy")
    done = as_process(*command, "--out", tmp_path / "clean")
    assert "livingroom1 with simulated Kinect noise" in " ".join(done.stdout.split()), done.stderr
    # The measurements of depth_noisy/ are half a metre too far: a map of them is wrong by clean depth.
    assert right("noisy") < 0.1
    assert right("clean") > 0.5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["table2", "--data", "."], ["no folder house_livingroom/", "in no known layout", "depth_noisy/"]),
        (["table3", "--only", "room"], ["--only: eval table3 has no parts"]),
        (["peers", "--only", "attic"], ["no part matches attic"]),
        (["table3", "--data", "no/such"], ["no/such", "no such folder", "--data"]),
        (["table1", "--data", "."], ["coffin_world/clean_depth.npz", "No such file"]),
        (["table1", "--judge", "kinect_one"], ["--judge: eval table1 is not judged by another sensor"]),
        (["table3", "--judge", "kinect9"], ["kinect9: no such file", "kinect_one", "realsense_d435"]),
        (["table3", "--limit", "0"], ["--limit must be at least 1, not 0"]),
        (["table3", "--limit", "1"], ["seven_scenes_redkitchen: 1 views", "at least 2"]),
        (["table3", "--voxel-sizes", "0.1", "-0.2"], ["--voxel-sizes must be positive", "-0.2"]),
        (["table3", "--voxel-sizes", "nan"], ["--voxel-sizes must be positive"]),
        (["table3", "--voxel-sizes", "0.1", "0.1"], ["--voxel-sizes holds a value twice"]),
        (["table1", "--seeds", "-1"], ["--seeds must not be negative, not -1"]),
        (["table1", "--seeds", "1", "1"], ["--seeds holds a value twice"]),
        (["table1", "--seeds"], ["--seeds needs at least one number"]),
    ],
)
def test_bad_input_is_one_line(data: Path, tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    if "--data" not in arguments:
        arguments = [*arguments, "--data", str(data)]
    done = taichi_mrf("eval", *arguments, "--out", tmp_path / "out", *CPU)
    assert_refused(done, *words)
    assert list(tmp_path.glob("out/*.csv")) == []


def test_table2_refuses_a_recording_in_another_layout(data: Path, tmp_path: Path) -> None:
    kitchen = data / "seven_scenes_redkitchen"
    done = taichi_mrf("eval", "table2", "--data", kitchen, "--out", tmp_path / "out", *CPU)
    assert_refused(done, "seven_scenes_redkitchen", "in the layout of 7-Scenes", "ICL-NUIM / Redwood")


@pytest.mark.parametrize(
    "arguments", [["table9"], ["table3", "--limit", "few"], ["table3", "--voxel-sizes", "x"]]
)
def test_what_cannot_be_parsed_is_a_usage_error(tmp_path: Path, arguments: list[str]) -> None:
    done = taichi_mrf("eval", *arguments, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert arguments[-1] in done.stderr
    assert not (tmp_path / "out").exists()


def test_results_of_another_version_are_refused(data: Path, tmp_path: Path) -> None:
    ledger = tmp_path / "table3.jsonl"
    ledger.write_text(json.dumps({"made_with": {"backend": "cpu", "version": "0.0.1"}}) + "\n")
    before = ledger.read_bytes()
    done = taichi_mrf("eval", "table3", "--data", data, "--out", tmp_path, "--voxel-sizes", "0.2", *CPU)
    assert_refused(done, "table3.jsonl", "another version")
    assert ledger.read_bytes() == before


@pytest.mark.parametrize("method", ["log_odds", "visibility"])
def test_map_makes_maps_of_the_other_methods(tmp_path: Path, method: str) -> None:
    mapped(ROOM, "--out", tmp_path, "--method", method, "--limit", "3", *FAST)
    report = report_of(tmp_path)
    assert (report["method"], report["keyframes"]) == (method, 3)
    m = load_map(tmp_path / "map.npz")
    assert m.config.method == method
    centres, probability = m.voxels(min_probability=0.0)
    assert len(centres) > 50
    np.testing.assert_allclose(m.occupancy(centres), probability, atol=1e-6)
    assert probability.min() < 0.45
    for other in {"mrf", "log_odds", "visibility"} - {method}:
        done = taichi_mrf("map", ROOM, "--out", tmp_path, "--resume", "--method", other, "--no-pictures")
        assert_refused(done, "config.yaml", "method")
    mapped(ROOM, "--out", tmp_path, "--resume", "--limit", "5", "--no-pictures")
    resumed = report_of(tmp_path)
    assert (resumed["method"], resumed["keyframes"]) == (method, 5)


def test_a_recording_at_an_ordinary_rate_gives_a_visibility_map_and_an_empty_map_says_so(
    tmp_path: Path,
) -> None:
    visibility = (ROOM, "--method", "visibility", "--limit", "6", *FAST)
    assert "map is empty" not in mapped(*visibility, "--out", tmp_path / "full")
    assert len(load_map(tmp_path / "full" / "map.npz").voxels(min_probability=0.5)[0]) > 200
    done = taichi_mrf("map", *visibility, "--sensor.max-depth", "0.2", "--out", tmp_path / "empty")
    assert done.returncode == 4
    assert "Note: The map is empty" not in done.stdout
    assert "m, beyond sensor.max_depth, 0.2 m. The files are kept" in " ".join(done.stderr.split())
    assert "map is empty" in report_of(tmp_path / "empty")["refused"]
    assert "Note: The map is empty" in mapped(
        *visibility, "--sensor.max-depth", "0.2", "--out", tmp_path / "forced", "--force"
    )
