"""The files of apps/ as a person starts them in a clone: at most, what they depend on is installed."""

import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import urllib.request
import venv
from pathlib import Path

import pytest
from live_program import DEADLINE_S, wait_for

from taichi_mrf.cli.commands import COMMANDS
from taichi_mrf.cli.start import start
from taichi_mrf.system import compiler

APPS = {"batch": "map", "live": "live", "tune": "tune"}
"""Each file, and the command that it is."""

ROOM = "synthetic:room?frames=9&width=80&height=60"
FLAGS = ("--voxel-size", "0.1", "--runtime.arch", "cpu")
CHECKED_OUT = ("apps", "configs", "taichi_mrf", "pyproject.toml")
DEPENDENCIES = sysconfig.get_paths()["purelib"]


@pytest.fixture(scope="module")
def clone(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("a clone")
    for name in CHECKED_OUT:
        source = repository / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    return folder


def interpreter(folder: Path, *lines: str) -> Path:
    """An interpreter without packages that carries out ``lines`` of a .pth file, which may lead to some."""
    venv.create(folder, with_pip=False)
    (next(folder.rglob("site-packages")) / "test.pth").write_text("\n".join(lines))
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


@pytest.fixture(scope="module")
def python(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter with what this package depends on, and without this package."""
    if request.config.getoption("--quick"):
        pytest.skip("left out by --quick: it starts processes")
    return interpreter(tmp_path_factory.mktemp("python"), DEPENDENCIES)


def environment() -> dict[str, str]:
    """A user's, who has chosen neither a place of modules nor a compiler, as a run of the suite has."""
    ours = ("PYTHONPATH", compiler.VARIABLE)
    return {name: value for name, value in os.environ.items() if name not in ours}


def run(python: Path, cwd: Path, *words: str | Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [python, *words], capture_output=True, text=True, check=False, cwd=cwd, env=environment()
    )


def test_each_file_is_what_its_command_carries_out(repository: Path) -> None:
    assert {path.stem for path in (repository / "apps").glob("*.py")} == set(APPS)
    for name, command in APPS.items():
        assert COMMANDS[command].function == f"taichi_mrf.apps.{name}:run_{command}"


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("3", "3")])
def test_products_take_one_thread_unless_more_are_asked_for(
    monkeypatch: pytest.MonkeyPatch, given: str | None, used: str
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", given or "")
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    monkeypatch.setattr(sys, "argv", ["taichi-mrf", "--version"])
    assert start() == 0
    assert os.environ["OPENBLAS_NUM_THREADS"] == used


def test_nothing_of_this_package_is_installed_here(python: Path, tmp_path: Path) -> None:
    assert "No module named 'taichi_mrf'" in run(python, tmp_path, "-c", "import taichi_mrf").stderr


def test_batch_leaves_the_folder_of_a_run(clone: Path, python: Path, tmp_path: Path) -> None:
    done = run(python, tmp_path, clone / "apps" / "batch.py", ROOM, "--out", "run", "--no-pictures", *FLAGS)
    assert done.returncode == 0, done.stderr
    assert {"map.npz", "voxels.ply", "report.json"} <= {path.name for path in (tmp_path / "run").iterdir()}


def test_batch_maps_several_in_processes_of_their_own(clone: Path, python: Path, tmp_path: Path) -> None:
    rooms = [f"synthetic:room?frames={frames}&width=80&height=60" for frames in (3, 4)]
    app = clone / "apps" / "batch.py"
    done = run(python, tmp_path, app, *rooms, "--out", "runs", "--no-pictures", *FLAGS)
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "runs").glob("*/map.npz"))) == 2


def test_tune_leaves_what_it_has_found(clone: Path, python: Path, tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    words = ("--no-viewer", "--auto", "1", "--stride", "1", "--out", "tuned")
    done = run(python, tmp_path, clone / "apps" / "tune.py", ROOM, *words, *FLAGS)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "tuned").iterdir()} == {"best.yaml", "tries.csv"}


@pytest.mark.parametrize("name", ["live", "tune"])
def test_the_page_is_served_until_ctrl_c(name: str, clone: Path, python: Path, tmp_path: Path) -> None:
    said: list[str] = []
    words = [python, clone / "apps" / f"{name}.py", ROOM, "--port", "0", *FLAGS]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path, env=environment()
    ) as process:
        assert process.stdout is not None
        reader = threading.Thread(target=said.extend, args=(process.stdout,), daemon=True)
        reader.start()
        try:
            address = wait_for(
                lambda: re.search(r" is at (http://\S+)", "".join(said)), lambda: f"the address in {said}"
            )
            assert isinstance(address, re.Match)
            with urllib.request.urlopen(address[1], timeout=DEADLINE_S) as page:
                assert b"<html" in page.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=DEADLINE_S) == 130
        finally:
            process.kill()
    assert "Traceback" not in "".join(said)


@pytest.mark.parametrize("name", APPS)
def test_without_its_dependencies_it_says_in_one_line_what_to_install(
    name: str, clone: Path, python: Path, tmp_path: Path
) -> None:
    bare = interpreter(tmp_path / "bare")
    done = run(bare, tmp_path, clone / "apps" / f"{name}.py", ROOM, "--out", "run")
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"taichi-mrf: the package \w+ is not installed: pip install .*\n", done.stderr)
    assert f"pip install '{clone}'" in done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "missing", "said"),
    [
        ("batch", ("taichi", "quadrants"), r"no compiler of kernels is installed: pip install 'taichi.*"),
        ("live", ("taichi", "quadrants"), r"no compiler of kernels is installed: pip install 'taichi.*"),
        ("live", ("viser",), r"the package viser is not installed: pip install .*"),
        ("tune", ("viser",), r"the package viser is not installed: pip install .*"),
    ],
)
def test_without_a_compiler_or_the_pages_library_it_says_so(
    name: str, missing: tuple[str, ...], said: str, clone: Path, python: Path, tmp_path: Path
) -> None:
    hidden = (f"import sys; sys.modules[{each!r}] = None" for each in missing)
    without = interpreter(tmp_path / "without", DEPENDENCIES, *hidden)
    done = run(without, tmp_path, clone / "apps" / f"{name}.py", ROOM, "--out", "run", *FLAGS)
    assert done.returncode == 2
    assert re.fullmatch(f"taichi-mrf: {said}\n", done.stderr)
    assert not (tmp_path / "run").exists()
