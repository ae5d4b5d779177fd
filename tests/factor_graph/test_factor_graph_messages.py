"""Closed forms of a beam's messages and of its slave, against sums and minima over all labellings."""

# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taichi_mrf.inference.first_occupied import NEVER, left_alone, message, next_ahead, next_behind
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, F32Array, Template

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]


@ti.kernel
def _messages(
    energies: F32Array, incoming: F32Array, steps: I32, out: F32Array, ahead: F32Array, value: F32Array,
    soft: Template,
):  # fmt: skip
    for _ in range(1):
        before, behind, alone = NEVER, energies[steps], 0.0
        for i in range(steps):
            ahead[i] = before
            before = next_ahead(before, energies[i], incoming[i], soft)
            alone += left_alone(incoming[i], soft)
        for back in range(steps):
            i = steps - 1 - back
            out[i] = message(ahead[i], energies[i], behind, soft)
            behind = next_behind(behind, energies[i], incoming[i], soft)
        value[0] = behind + alone


def least(costs: np.ndarray, soft: bool) -> float:
    lowest = costs.min()
    return float(lowest - np.log(np.exp(lowest - costs).sum())) if soft else float(lowest)


@settings(max_examples=150)
@given(
    steps=st.integers(1, 7), seed=st.integers(0, 2**32 - 1), soft=st.booleans(),
    scale=st.sampled_from([1.0, 30.0, 1000.0]),
)  # fmt: skip
def test_messages_and_slave_equal_enumeration(steps: int, seed: int, soft: bool, scale: float) -> None:
    random = np.random.default_rng(seed)
    energies = random.uniform(0, scale, steps + 1).astype(np.float32)
    incoming = (random.normal(size=steps) * scale * 1.5).astype(np.float32)
    out, ahead, value = np.zeros(steps, np.float32), np.zeros(steps, np.float32), np.zeros(1, np.float32)
    _messages(energies, incoming, steps, out, ahead, value, soft)

    labellings = np.array(list(itertools.product((0, 1), repeat=steps)))
    first = np.where(labellings.any(axis=1), labellings.argmax(axis=1), steps)
    costs = energies.astype(np.float64)[first] + labellings @ incoming.astype(np.float64)
    assert value[0] == pytest.approx(least(costs, soft), rel=1e-5, abs=1e-5 * scale * steps)
    for i in range(steps):
        others = costs - labellings[:, i] * incoming[i].astype(np.float64)
        occupied = labellings[:, i] == 1
        expected = least(others[occupied], soft) - least(others[~occupied], soft)
        assert out[i] == pytest.approx(expected, rel=1e-5, abs=1e-5 * scale)


def test_energies_of_a_thousand_neither_overflow_nor_vanish() -> None:
    energies = np.array([1000.0, 1000.0, 1.0, 900.0], np.float32)
    out, ahead, value = np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(1, np.float32)
    _messages(energies, np.array([1e5, -1e5, 3e5], np.float32), 3, out, ahead, value, True)
    assert np.isfinite(out).all()
    _messages(energies, np.zeros(3, np.float32), 3, out, ahead, value, True)
    np.testing.assert_allclose(out, [999.0 - np.log(4), 999.0 - np.log(4), -899.0], rtol=1e-5)
