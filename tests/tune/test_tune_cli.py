"""``taichi-mrf tune`` as a command: the search without a page, its files, and one line for bad input."""

import os
import re
import signal
from pathlib import Path

import pytest
from console import assert_refused, complaints, mapped, taichi_mrf
from live_program import LiveProgram, wait_for

from taichi_mrf.cli import main as cli
from taichi_mrf.config import schema as config

ROOM = "synthetic:room?frames=9&width=80&height=60"
FLAGS = ("--voxel-size", "0.1", "--stride", "1", "--runtime.arch", "cpu")


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder that a short search left, and what it said."""
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    out = tmp_path_factory.mktemp("tuned")
    done = taichi_mrf("tune", ROOM, "--no-viewer", "--auto", "3", "--out", out, *FLAGS)
    assert done.returncode == 0, done.stderr
    assert complaints(done.stderr) == ""
    return out, done.stdout


def test_a_search_without_a_page_leaves_parameters_table_and_verdict(searched: tuple[Path, str]) -> None:
    out, said = searched
    assert {path.name for path in out.iterdir()} == {"best.yaml", "tries.csv"}
    assert "6 frames of synthetic:room make the map, 2 score it, 1 are held back" in said
    assert re.search(r"log-likelihood +[+-]\d\.\d{3} +[+-]\d\.\d{3}  [+-]\d\.\d{3}\n", said)
    assert len((out / "tries.csv").read_text().splitlines()) == 4
    assert config.load(out / "best.yaml").voxel_size == 0.1
    assert "# Scores on 1 views that were never looked at before:" in (out / "best.yaml").read_text()


def test_map_accepts_what_was_found(searched: tuple[Path, str], tmp_path: Path) -> None:
    out, _ = searched
    flags = ("--limit", "2", "--no-pictures", "--evaluation.hold-out", "0")
    mapped(ROOM, "--config", out / "best.yaml", "--out", tmp_path, *flags)
    found, used = config.load(out / "best.yaml"), config.load(tmp_path / "config.yaml")
    assert used.inference == found.inference
    assert used.sensor == found.sensor


def test_ctrl_c_keeps_what_was_found(tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    search = ("--no-viewer", "--auto", "500", "--out", tmp_path)
    with LiveProgram(ROOM, *search, *FLAGS, command="tune", port=None) as program:
        wait_for(
            lambda: re.search(r"try +\d+  log", "\n".join(program.said)), lambda: f"a try in {program.said}"
        )
        assert program.end(signal.SIGINT)[0] == 130
    assert config.load(tmp_path / "best.yaml").voxel_size == 0.1
    assert len((tmp_path / "tries.csv").read_text().splitlines()) >= 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--no-viewer"], "--no-viewer leaves nothing to do: add --auto N"),
        (["--search", "inference.sweeps"], "--search needs a number of trials: add --auto N"),
        (["--hold-out", "1"], "--hold-out must be at least 2, not 1"),
        (["--auto", "2", "--no-viewer", "--search", "inference.swep"], "--search inference.swep: cannot be"),
        (["--auto", "2", "--no-viewer", "--first", "99"], "the first frame must lie between 0 and 8, not 99"),
    ],
)
def test_bad_input_gets_one_line(arguments: list[str], said: str) -> None:
    done = taichi_mrf("tune", ROOM, "--runtime.arch", "cpu", *arguments)
    assert_refused(done, said)
    assert done.stderr.startswith("taichi-mrf: ")


@pytest.mark.skipif(not hasattr(os, "getpriority"), reason="Windows has no such priorities")
def test_without_a_page_nothing_has_to_go_first(capsys: pytest.CaptureFixture[str]) -> None:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    assert cli.main(["tune", ROOM, "--no-viewer", "--auto", "1", "--search", "inference.swep"]) == 2
    assert "--search inference.swep" in capsys.readouterr().err
    assert os.getpriority(os.PRIO_PROCESS, 0) == before
