"""Which compiler of kernels is chosen, and that both make the same map."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from new_interpreter import output, python

from taichi_mrf.errors import BackendError
from taichi_mrf.system import compiler
from taichi_mrf.system.compiler import COMPILERS, VARIABLE

BOTH = all(importlib.util.find_spec(name) for name in COMPILERS)
MAP = """
import json, os, sys
import numpy as np
import taichi_mrf as tm
tm.init("cpu")
m = tm.MRFMap(0.1, tm.PolynomialNoise((0.01, 0.0, 0.002)))
camera = tm.PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5)
columns, rows = np.meshgrid(np.arange(80), np.arange(60))
depth_m = np.where(columns < 30 + rows // 3, 1.5 + columns / 64, 2.75 - rows / 128).astype(np.float32)
for step in range(4):
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = 0.25 * step
    m.add_keyframe(depth_m, T_world_camera, camera)
m.infer(2)
centres, p = m.voxels(0.0)
np.savez(os.environ["OUT"], centres=centres, p=p)
print(json.dumps([name for name in ("taichi", "quadrants") if name in sys.modules]))
"""


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """The compilers of this machine, which a test may change; none is asked for."""
    found: set[str] = set()
    monkeypatch.setattr(compiler, "_is_installed", found.__contains__)
    monkeypatch.delenv(VARIABLE, raising=False)
    return found


def chosen() -> str:
    return compiler.name.__wrapped__()  # what a new process would find


def test_taichi_comes_first_and_quadrants_where_it_is_alone(installed: set[str]) -> None:
    installed.add("quadrants")
    assert chosen() == "quadrants"
    installed.add("taichi")
    assert chosen() == "taichi"


def test_the_environment_chooses(installed: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    installed |= set(COMPILERS)
    for name in COMPILERS:
        monkeypatch.setenv(VARIABLE, name)
        assert chosen() == name
    monkeypatch.setenv(VARIABLE, "")
    assert chosen() == "taichi"


def test_without_a_compiler_the_error_says_what_to_install(
    installed: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BackendError, match=r"pip install 'taichi>=.* or pip install 'taichi-mrf\[quad"):
        chosen()
    installed.add("taichi")
    monkeypatch.setenv(VARIABLE, "quadrants")
    with pytest.raises(BackendError, match=r"'quadrants', which is not installed: pip install 'taichi-mrf\["):
        chosen()


def test_an_unknown_compiler_is_one_line_that_names_both() -> None:
    said = f"unknown compiler 'numba' in {VARIABLE}; use taichi, quadrants"
    info = "import taichi_mrf.cli.main as c, sys; sys.exit(c.main(['info']))"
    done = python("-c", info, **{VARIABLE: "numba"})
    assert done.returncode != 0
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_folder_of_that_name_is_no_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "no_compiler").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    assert importlib.util.find_spec("no_compiler") is not None
    assert not compiler._is_installed("no_compiler")


@pytest.mark.compilers
def test_kernels_are_those_of_the_compiler_that_was_chosen(backend: str) -> None:
    from taichi_mrf.system.compiler import ti

    assert ti.__name__ == compiler.name()
    assert compiler.program() is not None
    assert compiler.is_loaded()


@pytest.mark.skipif(not BOTH, reason="Taichi or Quadrants is not installed")
def test_both_compilers_make_the_same_map(tmp_path: Path) -> None:
    maps = {}
    for name in COMPILERS:
        path = tmp_path / f"{name}.npz"
        assert json.loads(output(MAP, OUT=str(path), **{VARIABLE: name})) == [name]
        maps[name] = np.load(path)
    one, other = maps.values()
    np.testing.assert_array_equal(one["centres"], other["centres"])
    np.testing.assert_allclose(one["p"], other["p"], atol=1e-5)
    assert np.ptp(one["p"]) > 0.5
