"""Every method against enumeration on graphs of up to 16 cells, for both sensor models."""

from pathlib import Path

import factor_graph_scenes
import numpy as np
import pytest
from factor_graph_scenes import CELL, beams_of, corner_beams, random_beams, room_beams
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from new_interpreter import python
from oracles import factor_graph as reference

from taichi_mrf.factor_graph.beams import Beams
from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.dual_decomposition import BlockAscent, DualDecomposition
from taichi_mrf.factor_graph.graph import FactorGraph, build_graph
from taichi_mrf.factor_graph.potentials import UNITS
from taichi_mrf.factor_graph.solve import METHODS, Step, energy, solve

pytestmark = pytest.mark.usefixtures("backend")

SENSORS = st.sampled_from(["piecewise", "gaussian"])
SEEDS = st.integers(0, 2**32 - 1)
MILD = {"energy_explained": 0.2, "energy_free": 1.6, "energy_wrong": 2.3, "sigma": 0.4}
"""Energies at which every labelling has some probability."""


def prepared(beams: Beams, **overrides: object) -> tuple[FactorGraph, LaserConfig, list[reference.Factor]]:
    graph = build_graph(beams, CELL)
    config = LaserConfig(**overrides)  # type: ignore[arg-type]
    return graph, config, reference.factors_of(beams, graph.grid, config)


def setting(beams: Beams, **overrides: object) -> tuple[FactorGraph, LaserConfig, reference.Enumeration]:
    graph, config, factors = prepared(beams, **overrides)
    begins, cells = graph.begins.to_numpy(), graph.cells.to_numpy()
    same = all(cells[begins[f] : begins[f + 1]].tolist() == factor.cells for f, factor in enumerate(factors))
    assume(same)  # a beam through a corner may go round it either way
    assume(graph.connected.sum() <= 16)
    return graph, config, reference.enumerate_all(factors, graph.grid.cells)


def tree(seed: int, number: int) -> Beams:
    beams = corner_beams(seed, number)
    graph = build_graph(beams, CELL)
    assume(reference.is_tree(reference.factors_of(beams, graph.grid, LaserConfig())))
    return beams


@settings(max_examples=60)
@given(
    seed=SEEDS,
    number=st.integers(1, 3),
    sensor=SENSORS,
    schedule=st.sampled_from(["parallel", "random", "residual"]),
)
def test_sum_product_is_exact_on_trees(seed: int, number: int, sensor: str, schedule: str) -> None:
    graph, config, exact = setting(
        tree(seed, number), method="bp", sensor=sensor, schedule=schedule, damping=0.0, tolerance=0.0,
        iterations=20, **MILD,
    )  # fmt: skip
    marginals = solve(graph, config).marginals
    assert marginals is not None
    np.testing.assert_allclose(marginals[exact.cells], exact.marginals, atol=1e-5)


@settings(max_examples=60)
@given(
    seed=SEEDS,
    number=st.integers(1, 3),
    sensor=SENSORS,
    method=st.sampled_from(["bp", "max-product", "dd", "dd-block"]),
)
def test_the_best_labelling_of_a_tree_is_found(seed: int, number: int, sensor: str, method: str) -> None:
    beams = tree(seed, number)
    graph, config, exact = setting(
        beams,
        method=method,
        sensor=sensor,
        damping=0.0,
        iterations=5000,
        step=1000.0,
        polish=0,
        sigma=0.2,
        charge="mean",
    )
    found = solve(graph, config)
    least = exact.energies.min()
    assert found.energy >= least - 1e-2
    if method in ("max-product", "bp"):
        unique = (np.abs(exact.differences) > 1).all()  # where labels tie, max-marginals do not tell them
        assume(unique)
    assert found.energy == pytest.approx(least, abs=1e-2)


@pytest.mark.usefixtures("one_backend")
@settings(max_examples=80)
@given(seed=SEEDS, number=st.integers(1, 12), sensor=SENSORS, method=st.sampled_from(["dd", "dd-block"]))
def test_the_dual_never_exceeds_the_least_energy(seed: int, number: int, sensor: str, method: str) -> None:
    graph, config, exact = setting(
        random_beams(seed, number),
        method=method,
        sensor=sensor,
        iterations=60,
        step=400.0,
        sigma=0.2,
        charge="mean",
    )
    found = solve(graph, config)
    assert found.dual is not None
    duals = [step.dual for step in found.trace]
    assert duals == sorted(duals)  # type: ignore[type-var]
    assert found.dual <= exact.energies.min() + 1e-3 * number
    if found.energy - found.dual < 1e-3:  # a closed gap is a certificate
        assert found.energy == pytest.approx(exact.energies.min(), abs=1e-2)


@pytest.mark.usefixtures("one_backend")
@settings(max_examples=40)
@given(seed=SEEDS, number=st.integers(1, 12), sensor=SENSORS)
def test_the_dual_is_a_bound_when_slaves_are_charged_the_whole_step(
    seed: int, number: int, sensor: str
) -> None:
    graph, config, exact = setting(
        random_beams(seed, number), method="dd", sensor=sensor, charge="whole", iterations=60, sigma=0.2
    )
    found = solve(graph, config)
    assert found.dual is not None
    assert found.dual <= exact.energies.min() + 1e-3 * number


@pytest.mark.usefixtures("one_backend")
@settings(max_examples=20)
@given(seed=SEEDS, number=st.integers(2, 10))
def test_block_ascent_never_lowers_the_bound(seed: int, number: int) -> None:
    graph, config, _ = setting(random_beams(seed, number), method="dd-block")
    ascent = BlockAscent(graph, config)
    last = -np.inf
    for _ in range(30):
        ascent.dual = -np.inf
        ascent.iterate()
        assert ascent.dual >= last
        last = ascent.dual


def test_whole_charges_are_the_step_for_each_slaves_own_choice() -> None:
    graph, config, _ = prepared(random_beams(7, 10), method="dd", charge="whole", step=64.0)
    dual = DualDecomposition(graph, config)
    dual.iterate()
    ones, degrees = dual.ones.copy(), graph.degrees.to_numpy()
    apart = (ones > 0) & (ones < degrees)
    assert apart.any()
    begins, cells = graph.begins.to_numpy(), graph.cells.to_numpy()
    for f in range(graph.beams):
        for edge in range(begins[f], begins[f + 1]):
            # The first slaves have no multipliers, so behind the first occupied cell all are free.
            sign = 1 if edge == begins[f] + dual.firsts[f] else -1
            wanted = sign * 64.0 * UNITS if apart[cells[edge]] else 0
            assert dual.multipliers[edge] == wanted


@settings(max_examples=30)
@given(seed=SEEDS, number=st.integers(1, 10), charge=st.sampled_from(["mean", "whole"]))
def test_multipliers_and_their_rest_sum_to_zero(seed: int, number: int, charge: str) -> None:
    graph, config, _ = setting(random_beams(seed, number), method="dd", step=333.0, charge=charge)
    dual = DualDecomposition(graph, config)
    for _ in range(20):
        dual.iterate()
    sums = np.bincount(
        graph.cells.to_numpy()[: graph.edges], dual.multipliers.to_numpy()[: graph.edges], graph.grid.cells
    )
    np.testing.assert_array_equal(sums, -dual.rest)


@settings(max_examples=25)
@given(seed=SEEDS, number=st.integers(1, 10), sensor=SENSORS, method=st.sampled_from(METHODS))
def test_every_method_is_judged_by_the_same_energy(seed: int, number: int, sensor: str, method: str) -> None:
    graph, config, exact = setting(
        random_beams(seed, number), method=method, sensor=sensor, iterations=8, sigma=0.2
    )
    found = solve(graph, config)
    assert found.energy == energy(graph, config, found.labels)
    index = np.flatnonzero((exact.labellings == found.labels[exact.cells]).all(axis=1))
    assert found.energy == pytest.approx(exact.energies[index[0]], abs=1e-3 * number)
    assert min(step.energy for step in found.trace) == found.energy
    assert not found.labels[~graph.connected].any()
    if found.marginals is not None:
        assert (found.marginals[~graph.connected] == 0.5).all()


@pytest.mark.usefixtures("one_backend")
@pytest.mark.parametrize("method", ["mh", "mh-heat"])
@pytest.mark.parametrize("sensor", ["piecewise", "gaussian"])
def test_metropolis_hastings_visits_labellings_as_often_as_they_are_probable(
    method: str, sensor: str
) -> None:
    graph, config, factors = prepared(
        random_beams(5, 9),
        method=method,
        sensor=sensor,
        iterations=3000,
        burn_in=0.01,
        chains=32,
        seed=3,
        **MILD,
    )
    exact = reference.enumerate_all(factors, graph.grid.cells)
    assert len(exact.cells) >= 8
    marginals = solve(graph, config).marginals
    assert marginals is not None
    # 96,000 sweeps over the cells, correlated over a few of them: a standard error of about 0.003.
    np.testing.assert_allclose(marginals[exact.cells], exact.marginals, atol=0.015)


@pytest.mark.parametrize("method", METHODS)
def test_results_are_the_same_again(method: str) -> None:
    graph = build_graph(room_beams(), 0.2)
    config = LaserConfig(method=method, iterations=6, seed=4)  # type: ignore[arg-type]
    first, again = solve(graph, config), solve(build_graph(room_beams(), 0.2), config)
    np.testing.assert_array_equal(first.labels, again.labels)
    assert [s.energy for s in first.trace] == [s.energy for s in again.trace]
    assert first.dual == again.dual
    if first.marginals is not None:
        np.testing.assert_array_equal(first.marginals, again.marginals)


PROGRAM = """
import sys
from factor_graph_scenes import room_beams
from taichi_mrf.system import runtime
runtime.init("cpu", threads=int(sys.argv[1]))
from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import build_graph
from taichi_mrf.factor_graph.solve import METHODS, solve
graph = build_graph(room_beams(), 0.2)
for method in METHODS:
    found = solve(graph, LaserConfig(method=method, iterations=5))
    print(method, found.energy, found.dual, found.labels.tobytes().hex())
    print(None if found.marginals is None else found.marginals.tobytes().hex())
"""


@pytest.mark.usefixtures("one_backend")
def test_results_do_not_depend_on_the_number_of_threads() -> None:
    """A process has one number of threads, so each is a process of its own."""
    folder = Path(factor_graph_scenes.__file__).parent
    one, two = (python("-c", PROGRAM, threads, cwd=folder) for threads in ("1", "2"))
    assert (one.returncode, len(one.stdout.splitlines())) == (0, 2 * len(METHODS))
    assert (one.returncode, one.stdout) == (two.returncode, two.stdout)


@pytest.mark.parametrize("method", METHODS)
def test_no_beams_and_one_beam_within_one_cell(method: str) -> None:
    config = LaserConfig(method=method, iterations=30)  # type: ignore[arg-type]
    nothing = solve(build_graph(beams_of([]), CELL), config)
    assert nothing.energy == 0
    assert not nothing.labels.any()
    graph = build_graph(beams_of([(0.1, 0.1, 0.3, 0.2, True)]), CELL)
    found = solve(graph, config)
    assert found.energy == config.energy_explained
    assert found.explained == 1.0
    np.testing.assert_array_equal(found.labels, graph.connected)


def test_a_progress_call_that_returns_false_ends_it_and_keeps_what_is_there() -> None:
    graph = build_graph(room_beams(), 0.2)
    steps: list[Step] = []

    def three(step: Step) -> bool:
        steps.append(step)
        return len(steps) < 3

    found = solve(graph, LaserConfig(method="dd", polish=0), three)
    assert [step.iteration for step in found.trace] == [0, 1, 2]
    assert found.energy == min(step.energy for step in steps)


@pytest.mark.usefixtures("one_backend")
def test_on_a_room_message_passing_ends_lower_than_the_inverse_model_and_than_sampling() -> None:
    graph = build_graph(room_beams(12, 180), 0.2)
    energies = {
        method: solve(graph, LaserConfig(method=method, iterations=40)).energy  # type: ignore[arg-type]
        for method in METHODS
    }
    for method in ("bp", "max-product", "dd", "dd-block"):
        assert energies[method] < min(energies["inverse"], energies["mh"], energies["mh-heat"])


def test_descent_never_raises_the_energy() -> None:
    graph = build_graph(room_beams(), 0.2)
    plain, polished = (
        solve(graph, LaserConfig(method="dd", iterations=10, polish=polish)) for polish in (0, 5)
    )
    assert polished.energy <= plain.energy
    assert polished.trace[-1].energy == polished.energy
