"""Taichi starts, and ends, wherever a program may run: without HOME, and where HOME cannot be written to."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import taichi_mrf
from taichi_mrf.system import compiler, taichi_environment
from taichi_mrf.system.compiler import COMPILERS

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Taichi needs no variable on Windows")

KERNEL = """
import taichi_mrf as tm
tm.init("cpu")
from taichi_mrf.system.compiler import ti

@ti.kernel
def one() -> ti.i32:
    return 1

print(one())
"""
CACHE = compiler.variable("OFFLINE_CACHE_FILE_PATH")
USUAL = "/".join(COMPILERS[compiler.name()].cache)
NAMES = ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", CACHE)


def run(tmp_path: Path, *, program: str = KERNEL, **variables: str) -> subprocess.CompletedProcess[str]:
    (tmp_path / "tmp").mkdir(exist_ok=True)
    (tmp_path / "program.py").write_text(program)  # Taichi reads a kernel's source in its file
    clean = {name: value for name, value in os.environ.items() if name not in NAMES}
    return subprocess.run(
        [sys.executable, str(tmp_path / "program.py")],
        capture_output=True,
        text=True,
        check=False,
        env={**clean, "TMPDIR": str(tmp_path / "tmp"), **variables},
    )


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({}, "HOME is not set"),
        ({"HOME": ""}, "HOME is not set"),
        ({"HOME": "/dev/null"}, f"/dev/null/.cache/{USUAL} cannot be written to"),
        ({"HOME": "/tmp", "XDG_CACHE_HOME": "/dev/null"}, f"/dev/null/{USUAL} cannot be written to"),
        ({"HOME": "/tmp", CACHE: "/dev/null/x"}, "/dev/null/x cannot be written to"),
    ],
)
def test_without_a_usual_folder_the_cache_is_private_and_this_is_said(
    tmp_path: Path, variables: dict[str, str], said: str
) -> None:
    done = run(tmp_path, **variables)
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr
    folder = tmp_path / "tmp" / f"taichi-mrf-{os.getuid()}"
    assert done.stderr == f"{said}: {compiler.title()} keeps its compiled kernels in {folder}\n"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert any(folder.iterdir())


@pytest.mark.parametrize("name", ["HOME", "XDG_CACHE_HOME", CACHE])
def test_a_folder_that_can_be_made_is_used_without_a_word(tmp_path: Path, name: str) -> None:
    done = run(tmp_path, **{name: str(tmp_path / "new")})
    assert (done.returncode, done.stdout, done.stderr) == (0, "1\n", "")
    assert any(path.suffix in {".tcb", ".qdc"} for path in (tmp_path / "new").rglob("*"))
    if name == CACHE:
        assert not any((tmp_path / "tmp").glob("taichi-mrf-*/*"))


@pytest.mark.parametrize(
    "variables", [{"HOME": "/dev/null"}, {"HOME": "/tmp", "XDG_CONFIG_HOME": "/dev/null"}]
)
def test_matplotlib_prints_nothing_where_home_cannot_be_written_to(
    tmp_path: Path, variables: dict[str, str]
) -> None:
    done = run(tmp_path, program="import taichi_mrf, matplotlib.font_manager\n", **variables)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "tmp" / f"taichi-mrf-{os.getuid()}" / "matplotlib").is_dir()


def test_a_folder_that_others_can_write_to_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    own = tmp_path / f"taichi-mrf-{os.getuid()}"
    assert taichi_environment._private_folder() == str(own)
    assert taichi_environment._private_folder() == str(own)
    own.chmod(0o777)
    other = taichi_environment._private_folder()
    assert other != str(own)
    assert other is not None
    assert Path(other).parent == tmp_path


def test_without_any_folder_taichi_is_not_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE, "/dev/null/x")
    assert f"set {CACHE}" in str(taichi_environment.cache_problem())
    monkeypatch.setenv(CACHE, str(tmp_path / "x"))
    assert taichi_environment.cache_problem() is None


def test_all_public_names_load_with_warnings_as_errors(tmp_path: Path) -> None:
    program = "import warnings; warnings.simplefilter('error'); import taichi_mrf\n"
    program += "".join(f"taichi_mrf.{name}\n" for name in taichi_mrf.__all__)
    done = run(tmp_path, program=program, HOME=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")


def test_the_first_run_says_where_kernels_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE, str(tmp_path / "kernels"))
    note = taichi_environment.first_run_note()
    assert note is not None
    assert note.endswith(f"kept in {tmp_path / 'kernels'}")
    (tmp_path / "kernels").mkdir()
    assert taichi_environment.first_run_note() == note
    (tmp_path / "kernels" / "kernel.tic").touch()
    assert taichi_environment.first_run_note() is None
