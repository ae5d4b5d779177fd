# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.
"""Notes of where a part of a kernel stands: short while it compiles, whole in an error."""

import ast
from typing import Any

import pytest

import taichi_mrf.kernels.bundles  # noqa: F401 - shortens the notes
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
