"""Repeated launches: arguments come through as at the first, in every form, and mistakes are told."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.system import compiler
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array, IVec3, Mat3, Template, Vec3, Vec4Array

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends, pytest.mark.compilers]


@kernel
def _told(
    number: F32, whole: I32, vector: Vec3, cell: IVec3, matrix: Mat3, twice: Template, out: F32Array
) -> None:
    """Write all arguments to ``out`` (17), doubled if asked."""
    for i in range(out.shape[0]):
        value = number
        if i == 1:
            value = ti.cast(whole, ti.f32)
        for k in ti.static(range(3)):
            if i == 2 + k:
                value = vector[k]
            if i == 5 + k:
                value = ti.cast(cell[k], ti.f32)
            for j in ti.static(range(3)):
                if i == 8 + 3 * k + j:
                    value = matrix[k, j]
        if ti.static(twice):
            value *= 2.0
        out[i] = value


@kernel
def _add(values: AnyArray, out: AnyArray) -> None:
    for i in range(out.shape[0]):
        out[i] += values[i]


@kernel
def _sum_of(vectors: Vec4Array, out: F32Array) -> None:
    for i in range(out.shape[0]):
        out[i] = vectors[i].sum()


@contextmanager
def taichis_own_way() -> Iterator[list[str]]:
    """The names of the kernels that Taichi itself launches while the block runs."""
    kernels, names = compiler.kernel_class(), list[str]()
    launch = kernels.launch_kernel

    def watched(self: Any, *arguments: Any, **named: Any) -> Any:
        names.append(self.func.__name__)
        return launch(self, *arguments, **named)

    kernels.launch_kernel = watched
    try:
        yield names
    finally:
        kernels.launch_kernel = launch


def told(*arguments: Any) -> NDArray[np.float32]:
    out = np.zeros(17, np.float32)
    _told(*arguments, out)
    return out


numbers = st.floats(-1e6, 1e6, width=32)
wholes = st.integers(-(2**20), 2**20)


@settings(max_examples=30)
@given(
    numbers, wholes, st.lists(numbers, min_size=3, max_size=3), st.lists(wholes, min_size=3, max_size=3),
    st.lists(numbers, min_size=9, max_size=9), st.booleans(), st.integers(0, 2),
)  # fmt: skip
def test_numbers_and_vectors_of_all_forms_come_through(
    number: float,
    whole: int,
    vector: list[float],
    cell: list[int],
    matrix: list[float],
    twice: bool,
    form: int,
) -> None:
    square = np.array(matrix, np.float32).reshape(3, 3)
    forms: list[tuple[Any, ...]] = [
        (number, whole, ti.Vector(vector), ti.Vector(cell), ti.Matrix(square.tolist())),
        (np.float32(number), np.int32(whole), np.array(vector), np.array(cell), square),
        (np.float64(number), np.int64(whole), Vec3(vector), IVec3(cell), Mat3(square.tolist())),
    ]
    expected = np.array([number, whole, *vector, *cell, *matrix], np.float32) * (2 if twice else 1)
    for _ in range(2):
        np.testing.assert_array_equal(told(*forms[form], twice), expected)


def test_only_the_first_launch_with_such_arguments_is_taichis() -> None:
    if compiler.name() != "taichi":
        pytest.skip("Quadrants has a way of its own for repeated launches")
    vectors = Vec3(1.0), IVec3(1), Mat3(np.eye(3).tolist())
    told(0.5, 1, *vectors, False)
    told(0.5, 1, *vectors, True)
    with taichis_own_way() as names:
        told(0.5, 1, *vectors, False)
        told(1, 2, *vectors, True)
    assert names == []
    with taichis_own_way() as names:
        told(0.5, 1, *vectors, 3)  # another template
    assert names == ["_told"]


def test_arrays_of_other_types_and_places_are_told_apart() -> None:
    host, wide = np.arange(4, dtype=np.int32), np.arange(4, dtype=np.float32) + 0.5
    on_device = ti.ndarray(ti.f32, 4)
    on_device.from_numpy(wide)
    for _ in range(2):
        out = np.zeros(4, np.float32)
        for values in (host, wide, on_device):
            _add(values, out)
        np.testing.assert_array_equal(out, host + 2 * wide)
        result = ti.ndarray(ti.f32, 4)
        _add(wide, result)
        np.testing.assert_array_equal(result.to_numpy(), wide)


def test_arrays_of_vectors_of_the_host_and_the_device() -> None:
    vectors = np.arange(12, dtype=np.float32).reshape(3, 4)
    on_device = ti.ndarray(ti.types.vector(4, ti.f32), 3)
    on_device.from_numpy(vectors)
    for _ in range(2):
        for given_vectors in (vectors, on_device):
            out = np.zeros(3, np.float32)
            _sum_of(given_vectors, out)
            np.testing.assert_array_equal(out, vectors.sum(axis=1))


def test_mistakes_are_told_and_change_nothing() -> None:
    vectors = Vec3(1.0), IVec3(1), Mat3(np.eye(3).tolist())
    for _ in range(2):
        told(0.5, 1, *vectors, False)
    out = np.zeros(17, np.float32)
    mistakes: list[tuple[Any, ...]] = [
        ("half", 1, *vectors, False, out),
        (0.5, 1.5, *vectors, False, out),
        (0.5, 1, vectors[0], Vec3(0.5), vectors[2], False, out),
        (0.5, 1, *vectors, False, np.zeros(17, np.int32)),
        (0.5, 1, *vectors, False, np.zeros((17, 1), np.float32)),
        (0.5, 1, *vectors, False, np.zeros(34, np.float32)[::2]),
    ]
    for mistake in mistakes:
        with pytest.raises(Exception, match=r"."):
            _told(*mistake)
    assert not out.any()
    assert told(0.5, 1, *vectors, False)[0] == 0.5
