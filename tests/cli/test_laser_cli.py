"""``taichi-mrf laser`` as a person runs it: files that other tools open, one line for what is wrong."""

import csv
import signal
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from console import complaints, report_of, signalled, taichi_mrf
from laser_logs import flaser

from taichi_mrf.cli.main import BAD_INPUT, main
from taichi_mrf.cli.options.config_file import load_laser_config
from taichi_mrf.cli.options.laser import Laser
from taichi_mrf.cli.parser import parse
from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.solve import METHODS

SMALL = "synthetic:floor-plan?scans=60&beams=61"
QUICK = ("--runtime.arch", "cpu", "--iterations", "8")
FILES = {
    "map.png", "map.pgm", "map.yaml", "marginals.npz", "energy.csv", "energy.png",
    "config.yaml", "report.json",
}  # fmt: skip
MAP_FILES = FILES - {"config.yaml", "report.json"}
COMPARISON = {
    "energy.csv", "energy.png", "maps.png", "comparison.csv", "comparison.tex", "comparison.png",
    "config.yaml", "report.json",
}  # fmt: skip


def laser(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return taichi_mrf("laser", *arguments)


def mapped(*arguments: str | Path) -> str:
    """Run the command, which must succeed without complaints; returns what it printed."""
    done = laser(*arguments)
    assert done.returncode == 0, done.stderr
    assert complaints(done.stderr) == ""
    return done.stdout


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run of one method: its folder, and what it printed."""
    out = tmp_path_factory.mktemp("one") / "deep" / "out"
    return out, mapped(SMALL, "--out", out, "--method", "bp", "--cell-size", "0.2", *QUICK)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run of all methods: its folder, and what it printed."""
    out = tmp_path_factory.mktemp("all")
    return out, mapped(SMALL, "--out", out, "--compare", *QUICK)


def test_a_run_leaves_these_files_and_names_them(one: tuple[Path, str]) -> None:
    out, printed = one
    assert names(out) == FILES
    for name in FILES:
        assert str(out / name) in printed


def test_the_map_the_marginals_and_the_report_agree(one: tuple[Path, str]) -> None:
    out, _ = one
    arrays = np.load(out / "marginals.npz")
    occupied, seen = arrays["labels"] == 1, arrays["seen"]
    image = cv2.imread(str(out / "map.pgm"), cv2.IMREAD_UNCHANGED)[::-1]
    assert np.array_equal(image == 0, occupied & seen)
    assert np.array_equal(image == 254, ~occupied & seen)
    assert np.array_equal(image == 205, ~seen)
    where = yaml.safe_load((out / "map.yaml").read_text())
    assert where["resolution"] == arrays["cell_size"] == 0.2
    assert where["origin"] == [*arrays["origin"], 0.0]
    assert where["image"] == "map.pgm"
    assert arrays["marginals"].shape == seen.shape
    assert arrays["marginals"].min() >= 0
    assert arrays["marginals"].max() <= 1
    report = report_of(out)
    assert report["methods"]["bp"]["occupied_cells"] == int((occupied & seen).sum())
    assert report["cells_seen"] == int(seen.sum())
    assert report["scans"] == 60
    assert report["measurements"] == report["beams"] == 60 * 61
    assert 0 < report["methods"]["bp"]["explained"] <= 1
    assert report["graph_memory_mb"] > 0


def test_the_map_is_that_of_the_building(one: tuple[Path, str]) -> None:
    """By the scores in the report, and by looking at three places in the picture of map_server."""
    out, _ = one
    scores = report_of(out)["methods"]["bp"]["scores"]
    assert scores["occupied"]["precision"] > 0.95
    assert scores["occupied"]["recall"] > 0.8
    assert scores["free"]["iou"] > 0.95
    where = yaml.safe_load((out / "map.yaml").read_text())
    image = cv2.imread(str(out / "map.pgm"), cv2.IMREAD_UNCHANGED)

    def at(x: float, y: float) -> np.ndarray:
        column = int((x - where["origin"][0]) / where["resolution"])
        row = len(image) - 1 - int((y - where["origin"][1]) / where["resolution"])
        return image[row - 1 : row + 2, column - 1 : column + 2]

    assert (at(-6.0, 1.0) == 0).any()  # the corridor's northern wall
    assert (at(0.0, 0.0) == 254).all()  # the middle of the corridor
    assert (at(-4.6, 1.1) == 254).all()  # a door in that wall
    assert (at(0.0, 2.8) == 0).any()  # the near side of a pillar


def test_the_last_energy_in_the_file_is_the_least(one: tuple[Path, str]) -> None:
    out, _ = one
    with open(out / "energy.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["seconds", "iteration", "energy", "dual"]
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)
    assert [int(row["iteration"]) for row in rows] == list(range(len(rows)))
    method = report_of(out)["methods"]["bp"]
    energies = [float(row["energy"]) for row in rows]
    assert energies[-1] == min(energies) == pytest.approx(method["energy"])
    assert 1 < len(rows) == method["steps"] <= 8 + 1  # the iterations, and the descent that ends them


def test_the_configuration_is_read_back_and_repeats_the_run(one: tuple[Path, str], tmp_path: Path) -> None:
    out, _ = one
    config = load_laser_config(out / "config.yaml")
    assert config == LaserConfig(method="bp", cell_size=0.2, iterations=8)
    mapped(SMALL, "--out", tmp_path, "--config", out / "config.yaml", "--runtime.arch", "cpu")
    assert (tmp_path / "map.pgm").read_bytes() == (out / "map.pgm").read_bytes()
    assert (tmp_path / "config.yaml").read_text() == (out / "config.yaml").read_text()


def test_a_flag_goes_before_the_file(one: tuple[Path, str], tmp_path: Path) -> None:
    config = one[0] / "config.yaml"
    _, options = parse(
        ["laser", SMALL, "--out", str(tmp_path), "--config", str(config), "--cell-size", "0.5"]
    )
    assert isinstance(options, Laser)
    assert options.settings == LaserConfig(method="bp", cell_size=0.5, iterations=8)


def test_compare_runs_all_methods_and_draws_them(compared: tuple[Path, str]) -> None:
    out, printed = compared
    assert names(out) == COMPARISON | set(METHODS)
    for method in METHODS:
        assert names(out / method) == MAP_FILES
        assert method in printed
    for picture in ("maps.png", "energy.png", "comparison.png", "dd/map.png"):
        image = cv2.imread(str(out / picture))
        assert image is not None
        assert image.std() > 1
    with open(out / "energy.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(dict.fromkeys(row["method"] for row in rows)) == list(METHODS)
    assert any(row["dual"] for row in rows if row["method"] == "dd")
    assert not any(row["dual"] for row in rows if row["method"] == "bp")


def test_the_table_of_the_comparison_is_that_of_the_report(compared: tuple[Path, str]) -> None:
    out, _ = compared
    report = report_of(out)
    with open(out / "comparison.csv", encoding="utf-8", newline="") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(report["methods"]) == list(METHODS)
    for method, row in rows.items():
        facts = report["methods"][method]
        assert float(row["energy"]) == pytest.approx(facts["energy"], abs=0.5)
        assert float(row["explained %"]) == pytest.approx(100 * facts["explained"])
        for kind in ("occupied", "free"):
            assert float(row[f"{kind} precision"]) == pytest.approx(facts["scores"][kind]["precision"])
            assert float(row[f"{kind} recall"]) == pytest.approx(facts["scores"][kind]["recall"])
            assert float(row[f"{kind} IoU"]) == pytest.approx(facts["scores"][kind]["iou"])


def test_ctrl_c_keeps_what_is_there(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with signalled(signal.SIGINT, "mh", step=5):
        done = laser(
            SMALL, "--out", out, "--method", "mh", "--iterations", "1000000", "--runtime.arch", "cpu"
        )  # fmt: skip
    assert done.returncode == 130, done.stderr
    assert complaints(done.stderr) == ""
    assert "Stopped before the end" in done.stdout
    assert names(out) == FILES
    report = report_of(out)
    assert report["interrupted"]
    assert 1 <= report["methods"]["mh"]["steps"] < 1_000_000


def test_a_log_without_a_floor_plan_is_mapped(tmp_path: Path) -> None:
    log = tmp_path / "corridor.log"
    log.write_text("\n".join(flaser([2.0] * 90 + [81.91] * 90, (0.1 * i, 0, 0)) for i in range(20)))
    printed = mapped(log, "--out", tmp_path / "out", "--method", "inverse", "--runtime.arch", "cpu")
    report = report_of(tmp_path / "out")
    assert report["no_return_share"] == 0.5
    assert report["beams"] == 20 * 90  # no returns of a log say nothing
    assert report["floor_plan"] is None
    assert "precision" not in printed
    mapped(log, "--out", tmp_path / "free", "--no-returns", "free", "--max-range", "6", *QUICK)
    report = report_of(tmp_path / "free")
    assert report["beams"] == 20 * 180
    rows, columns = np.load(tmp_path / "free" / "marginals.npz")["seen"].shape
    margin = 4 * report["cell_size"]
    assert 2.0 + 6.0 <= rows * report["cell_size"] <= 2.0 + 6.0 + margin  # right hits at 2 m, left is cut
    assert 6.0 <= columns * report["cell_size"] <= 1.9 + 6.0 + margin


def test_steps_are_compared_and_drawn_without_a_floor_plan(tmp_path: Path) -> None:
    log, out = tmp_path / "walk.log", tmp_path / "out"
    log.write_text("\n".join(flaser([3.0] * 60, (0.1 * i, 0.0, 0.0)) for i in range(10)) + "\n")
    printed = mapped(log, "--out", out, "--steps", "20,500", "--charge", "whole", *QUICK)
    assert names(out) == COMPARISON | {"dd-step-20", "dd-step-500"}
    assert "dd-step-500" in printed
    methods = report_of(out)["methods"]
    assert list(methods) == ["dd-step-20", "dd-step-500"]
    assert methods["dd-step-20"]["dual"] != methods["dd-step-500"]["dual"]


def test_every_and_limit_choose_scans(tmp_path: Path) -> None:
    mapped(SMALL, "--out", tmp_path, "--every", "3", "--limit", "10", "--method", "inverse", *QUICK)
    assert report_of(tmp_path)["scans"] == 10
    assert names(tmp_path) == FILES


def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    broken = tmp_path / "broken.log"
    broken.write_text(flaser([1.0, 2.0], (0, 0, 0)) + "\nFLASER 2 nan 1.0 0 0 0\n")
    plan = tmp_path / "plan.png"
    cv2.imwrite(str(plan), np.full((8, 8), 255, dtype=np.uint8))
    config = tmp_path / "laser.yaml"
    config.write_text("cell_sise: 0.1\n")
    far = tmp_path / "far.log"
    far.write_text(flaser([81.91] * 4, (0, 0, 0)))
    for arguments, words in (
        ((broken,), (f"{broken}: line 2", "nan")),
        ((tmp_path / "nowhere.log",), ("nowhere.log", "no such file")),
        (("synthetic:floor-plan?scans=0",), ("scans", "at least 1")),
        ((SMALL, "--cell-size", "0.0001", "--memory-limit-gb", "0.5"), ("GB", "larger cell size")),
        ((SMALL, "--cell-size", "-1"), ("cell_size",)),
        ((SMALL, "--truth", plan), ("--truth-size",)),
        ((SMALL, "--truth", plan, "--truth-size", "16"), ("--truth-size", "'16'")),
        ((SMALL, "--truth", config, "--truth-size", "1,1"), ("laser.yaml", "not a readable image")),
        ((SMALL, "--config", config), ("laser.yaml", "cell_sise", "did you mean 'cell_size'")),
        ((SMALL, "--every", "0"), ("--every",)),
        ((SMALL, "--steps", "20,big"), ("--steps", "'20,big'")),
        ((SMALL, "--steps", "20,-1"), ("step", "positive")),
        ((SMALL, "--steps", "20,1e9"), ("step", "at most 10000")),
        ((SMALL, "--steps", "20,50", "--compare"), ("--compare", "--steps")),
        ((far,), ("far.log", "no beam")),
    ):
        assert main(["laser", *map(str, arguments), "--out", str(out), "--runtime.arch", "cpu"]) == BAD_INPUT
        printed, complaint = capsys.readouterr()
        assert printed == ""
        assert complaint.count("\n") == 1, complaint
        for word in words:
            assert word in complaint
        assert not out.exists()
    refused = laser(broken, "--out", out)
    assert (refused.returncode, refused.stdout) == (BAD_INPUT, "")
    assert refused.stderr.count("\n") == 1


def test_broken_scans_can_be_left_out(tmp_path: Path) -> None:
    log = tmp_path / "broken.log"
    log.write_text(
        "\n".join([flaser([1.0, 2.0], (0, 0, 0)), "FLASER 2 1.0", flaser([1.0, 2.0], (0.1, 0, 0))])
    )
    printed = mapped(log, "--out", tmp_path / "out", "--skip-bad-scans", *QUICK)
    assert "1 broken scans were left out" in printed
    assert report_of(tmp_path / "out")["scans"] == 2


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "size"), [("cave_player", "16,16"), ("hospital_section_player", "45.25,18.45")]
)
def test_the_papers_simulated_data_is_mapped_and_judged(
    shared_data: Path, tmp_path: Path, name: str, size: str
) -> None:
    folder = shared_data / "laser2d" / name
    truth = ("--truth", folder / "floorplan.png", "--truth-size", size)
    mapped(folder, "--out", tmp_path, *truth, "--method", "inverse", "--every", "16", *QUICK)
    report = report_of(tmp_path)
    scores = report["methods"]["inverse"]["scores"]
    assert scores["occupied"]["precision"] > 0.9
    assert scores["free"]["recall"] > 0.95
    assert report["floor_plan"]["walled_edge"] == (name == "cave_player")
