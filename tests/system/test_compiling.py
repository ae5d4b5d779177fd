"""Words for the time in which a run waits for the compiler of kernels."""

import itertools
from pathlib import Path
from typing import Any

import pytest
from new_interpreter import python

from taichi_mrf.system import compiler, compiling, runtime

PROGRAM = """
import sys
from taichi_mrf.cli.main import main
from taichi_mrf.system import compiling
compiling.WORTH_A_WORD_S = 0.2
sys.exit(main(["map", "synthetic:room?frames=4", "--no-pictures", "--verbose", "--out", sys.argv[1]]))
"""


def _map(out: Path, cache: Path) -> str:
    done = python("-c", PROGRAM, out, XDG_CACHE_HOME=str(cache))
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_a_run_says_that_it_compiles_and_says_nothing_of_it_when_all_is_compiled(tmp_path: Path) -> None:
    first = _map(tmp_path / "first", tmp_path / "cache")
    assert "compiling kernels, once on this machine: " in first
    assert "compiling" not in _map(tmp_path / "second", tmp_path / "cache")


@pytest.mark.compilers
def test_first_launches_are_counted_by_kernel(backend: str) -> None:
    from kernels_to_compile import double

    from taichi_mrf.system.compiler import ti

    told: list[str] = []
    waiting = compiling.Waiting(told.append)
    before = compiling.so_far.number
    values = ti.ndarray(ti.f32, 3)
    with compiling.told(waiting):
        double(values)
        assert compiling.so_far.number == before + 1
        assert compiling.so_far.seconds["double"] > 0.0
        double(values)
        assert compiling.so_far.number == before + 1
        assert told == []


def test_a_kernel_that_is_named_has_all_passes_and_the_next_has_not(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from kernels_to_compile import quadruple, triple

    from taichi_mrf.system.compiler import ti

    compile_kernel, asked = type(compiler.program()).compile_kernel, []

    def note(program: Any, config: Any, *arguments: Any) -> Any:
        asked.append(config.advanced_optimization)
        return compile_kernel(program, config, *arguments)

    monkeypatch.setattr(type(compiler.program()), "compile_kernel", note)
    monkeypatch.setattr(compiling, "all_passes", {"advanced_optimization": ("triple",)})
    monkeypatch.setattr(ti.cfg, "advanced_optimization", False)
    values = ti.ndarray(ti.f32, 3)
    for kernel in (triple, quadruple):
        kernel(values)
        kernel(values)
    assert asked[0]  # Taichi asks at each launch, and keeps what the first one made
    assert not any(asked[1:])


def test_kernels_that_keep_all_passes_are_kernels_of_this_package() -> None:
    sources = [path.read_text(encoding="utf-8") for path in Path(compiling.__file__).parents[1].rglob("*.py")]
    for settings in runtime.FEWER_PASSES.values():
        for name in itertools.chain(*settings.values()):
            assert sum(f"@kernel\ndef {name}(" in source for source in sources) == 1, name


def test_words_are_worth_it_after_a_second_since_the_last_step(monkeypatch: pytest.MonkeyPatch) -> None:
    so_far = compiling.Compiling()
    monkeypatch.setattr(compiling, "so_far", so_far)
    told: list[str] = []
    waiting = compiling.Waiting(told.append)
    so_far.seconds["large"], so_far.number = 0.9, 7
    waiting.look()
    assert told == []
    so_far.seconds["large"] = 1.1
    waiting.look()
    assert told == ["compiling kernels, once on this machine: 7 so far"]
    waiting.step()
    waiting.look()
    assert len(told) == 1
