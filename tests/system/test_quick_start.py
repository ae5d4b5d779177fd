# ruff: noqa: ANN201, ANN202 - Taichi does not allow `-> None` on a kernel or a func.
"""Notes of where a part of a kernel stands: short while it compiles, whole in an error; kernels that are
methods."""

import ast
from pathlib import Path
from typing import Any

import pytest
from new_interpreter import python

import taichi_mrf.system.bundles  # noqa: F401 - hastens the compiler
from taichi_mrf.system import compiler
from taichi_mrf.system.compiler import ti

pytestmark = pytest.mark.compilers


@pytest.mark.usefixtures("backend")
def test_notes_are_a_line_and_an_error_shows_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    noted: list[str] = []
    maker, method = compiler.note_maker()
    note = getattr(maker, method)

    def noted_too(context: Any, node: ast.expr) -> str:
        noted.append(note(context, node))
        return noted[-1]

    monkeypatch.setattr(maker, method, noted_too)

    @ti.kernel
    def faulty():
        first = 1
        print(first + of_no_kind)  # noqa: F821

    with pytest.raises(compiler.compilation_error()) as caught:
        faulty()
    assert "print(first + of_no_kind)" in str(caught.value)
    before = [text for text in noted if text not in str(caught.value)]
    assert before
    assert all(text.count("\n") == 1 and text.startswith(f'File "{__file__}", line ') for text in before)


@ti.data_oriented
class Adder:
    """Kernels and functions that are methods, which the compiler knows by the line that opens the class."""

    def __init__(self, step: int) -> None:
        self.step = step

    @ti.func
    def raised(self, x: ti.i32):
        return x + self.step

    @ti.kernel
    def twice_raised(self, x: ti.i32) -> ti.i32:
        return self.raised(self.raised(x))


@pytest.mark.usefixtures("backend")
def test_methods_are_known_as_such() -> None:
    assert Adder(3).twice_raised(1) == 7


def test_a_program_has_a_kernel_of_its_own_at_its_top(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import taichi_mrf.system.bundles\n"
        "from taichi_mrf.system.compiler import ti\n"
        "@ti.kernel\n"
        "def own(x: ti.f32) -> ti.f32:\n"
        "    return 2.0 * x\n"
        "import taichi_mrf\n"
        "taichi_mrf.init('cpu')\n"
        "print(own(4.0))\n"
    )
    done = python(program)
    assert (done.stdout, done.returncode) == ("8.0\n", 0), done.stderr
