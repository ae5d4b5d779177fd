# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.
"""Kernels that take bundles: arguments come through, methods are those of the class, and loops stay
parallel."""

from dataclasses import dataclass

import numpy as np
import pytest

from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, Template, Vec3

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.compilers]


@dataclass(frozen=True)
class _Law(Bundle):
    gain: F32

    @ti.func
    def of(self, x: F32):
        return self.gain * x


@dataclass(frozen=True)
class _Square(_Law):
    @ti.func
    def of(self, x: F32):
        return self.gain * x * x


@dataclass(frozen=True)
class _Problem(Bundle):
    law: _Law
    offset: Vec3
    values: F32Array
    doubled: Template


@ti.func
def _term(problem: Template, i: I32):
    value = problem.law.of(problem.values[i]) + problem.offset[i % 3]
    if ti.static(problem.doubled):
        value *= 2.0
    return value


@kernel
def _evaluate(problem: _Problem, times: I32, out: F32Array) -> None:
    """Docstrings stay."""
    for i in range(out.shape[0]):
        for _ in range(times):
            out[i] += _term(problem, i)


@kernel
def _count(counts: I32Array, step: I32) -> None:
    for i in range(counts.shape[0]):
        counts[i] += step


@pytest.mark.parametrize("doubled", [False, True])
@pytest.mark.parametrize("law", [_Law(0.5), _Square(0.25)])
def test_fields_methods_and_static_switches_come_through(law: _Law, doubled: bool) -> None:
    values, offset = np.arange(10, dtype=np.float32), np.array([1.0, 2.0, 3.0])
    out = np.zeros(10, np.float32)
    _evaluate(_Problem(law, ti.Vector(offset.tolist(), ti.f32), values, doubled), 3, out)
    expected = (0.25 * values**2 if isinstance(law, _Square) else 0.5 * values) + offset[np.arange(10) % 3]
    np.testing.assert_allclose(out, 3 * expected * (2 if doubled else 1), rtol=1e-6)


def test_the_same_classes_are_compiled_once_and_other_values_are_not_compiled_in() -> None:
    for step in (2, 5):
        counts = np.zeros(7, np.int32)
        _count(counts, step)
        assert (counts == step).all()
    counts = ti.ndarray(ti.i32, 7)
    counts.fill(1)
    _count(step=4, counts=counts)
    assert (counts.to_numpy() == 5).all()


def test_a_kernel_keeps_its_name_and_docstring() -> None:
    assert (_evaluate.__name__, _evaluate.__doc__) == ("_evaluate", "Docstrings stay.")


def test_a_wrong_number_of_arguments_is_a_type_error() -> None:
    with pytest.raises(TypeError, match="'step'"):
        _count(np.zeros(3, np.int32))
    with pytest.raises(TypeError, match="'stride'"):
        _count(stride=3, step=2, counts=np.zeros(3, np.int32))
