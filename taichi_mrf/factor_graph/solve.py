"""One call for every method: iterate, judge the labelling by its energy, and keep the best one.

Descent flips every cell whose flip lowers the energy, until none does. What belief propagation and dual
decomposition leave undecided is rounded cell by cell, which may leave labellings that a single flip improves.
Cells are taken in the order of their numbers, one after the other.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.factor_graph.belief_propagation import BeliefPropagation
from taichi_mrf.factor_graph.config import LaserConfig, Method
from taichi_mrf.factor_graph.dual_decomposition import BlockAscent, DualDecomposition
from taichi_mrf.factor_graph.graph import CellLists, FactorGraph
from taichi_mrf.factor_graph.metropolis_hastings import (
    SPREAD,
    MetropolisHastings,
    find_firsts,
    flip,
    flip_change,
    inverse_model,
)
from taichi_mrf.factor_graph.potentials import BeamGraph, beam_graph, energy, judged
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.types import I32, I32Array

__all__ = ["METHODS", "Solution", "Step", "energy", "solve"]

METHODS: tuple[str, ...] = get_args(Method)
"""Names of all methods."""

PROVED = 1e-9
"""A dual that is this near to the energy, as a share of it, proves that the labelling is the best."""


@dataclass(frozen=True)
class Step:
    """State of a method after an iteration."""

    seconds: float
    """Since the method began, compiling kernels included."""

    iteration: int
    """0 is the first."""

    energy: float
    """Of this iteration's labelling."""

    dual: float | None
    """The best lower bound so far; None for methods that prove none."""

    residual: float
    """Share of the cells on which slaves disagree (dual decomposition), whose belief has moved (belief
    propagation) or whose label has changed (Metropolis-Hastings)."""


@dataclass(frozen=True)
class Solution:
    """Result of a method; the labelling is that of the least energy which it came across."""

    labels: NDArray[np.uint8]
    """(cells,): 1 for occupied. A cell that no beam crosses is free."""

    marginals: NDArray[np.float32] | None
    """(cells,): probability of occupied, None for methods that only look for the best labelling."""

    energy: float
    dual: float | None
    trace: tuple[Step, ...]

    explained: float
    """Share of the beams that the labelling explains: only the last cell is occupied, or, without a return,
    none."""


class _Iterative(Protocol):
    """Interface of an iterative method, as :func:`solve` needs it."""

    def iterate(self) -> float: ...

    def labels(self) -> NDArray[np.uint8]: ...


def solve(
    graph: FactorGraph, config: LaserConfig, progress: Callable[[Step], bool] = lambda step: True
) -> Solution:
    """Label the graph by ``config.method``, for at most ``config.iterations`` iterations.

    ``progress`` is called after each iteration; where it returns False the method stops, and what it has
    found is kept. Taichi must run. Raises ConfigError for a method that needs beams which end where they
    measured, on a graph of depth rays, which do not.
    """
    started = time.perf_counter()
    sampled = config.method in ("mh", "mh-heat")
    needs_ends = config.method in ("inverse", "mh-heat") or (sampled and config.start == "inverse")
    if graph.has_table and needs_ends:
        raise ConfigError(
            f"{config.method} from {config.start} labels needs beams that end where they measured"
        )
    if config.method == "inverse":
        model = inverse_model(graph, config.log_odds)
        value, explained = judged(graph, config, model.labels)
        step = Step(time.perf_counter() - started, 0, value, None, 0.0)
        progress(step)
        return Solution(model.labels, model.marginals, value, None, (step,), explained)
    return _iterated(_method(graph, config), graph, config, progress, started)


def _method(graph: FactorGraph, config: LaserConfig) -> _Iterative:
    if config.method in ("mh", "mh-heat"):
        return MetropolisHastings(graph, config)
    if config.method in ("bp", "max-product"):
        return BeliefPropagation(graph, config)
    if config.method == "dd-block":
        return BlockAscent(graph, config)
    return DualDecomposition(graph, config)


def _iterated(
    method: _Iterative,
    graph: FactorGraph,
    config: LaserConfig,
    progress: Callable[[Step], bool],
    started: float,
) -> Solution:
    best = np.zeros(graph.grid.cells, np.uint8)
    least, explained = judged(graph, config, best)
    trace: list[Step] = []
    dual: float | None = None
    for iteration in range(config.iterations):
        if isinstance(method, MetropolisHastings) and iteration == int(config.burn_in * config.iterations):
            method.forget()
        residual = method.iterate()
        labels = method.labels()
        value, share = judged(graph, config, labels)
        if value < least or iteration == 0:
            least, explained, best = value, share, labels
        dual = method.dual if isinstance(method, DualDecomposition | BlockAscent) else None
        seconds = time.perf_counter() - started
        trace.append(Step(seconds, iteration, value, dual, residual))
        go_on = progress(trace[-1]) and not 0 < config.seconds <= seconds
        proved = dual is not None and least - dual <= PROVED * abs(least)
        still = residual == 0 and not isinstance(method, MetropolisHastings)
        if not go_on or proved or still:
            break
    if config.polish > 0 and not isinstance(method, MetropolisHastings) and trace:
        best = descended(graph, config, best, config.polish)
        least, explained = judged(graph, config, best)
        trace.append(Step(time.perf_counter() - started, len(trace), least, dual, trace[-1].residual))
        progress(trace[-1])
    marginals = None
    if config.method != "max-product" and isinstance(method, MetropolisHastings | BeliefPropagation):
        marginals = method.marginals()
    return Solution(best, marginals, least, dual, tuple(trace), explained)


@kernel
def _descend(
    graph: BeamGraph, lists: CellLists, labels: I32Array, firsts: I32Array, flips: I32Array, spread: I32
) -> None:
    """One sweep over all cells, by one thread.

    ``labels`` (cells) is 1 for occupied, ``firsts`` (beams) each beam's first occupied step. ``flips`` (1)
    receives how many cells were flipped.
    """
    for iteration in range(spread):
        if iteration == 0:
            flips[0] = 0
            for cell in range(labels.shape[0]):
                if flip_change(cell, labels, 0, firsts, 0, graph, lists) < 0:
                    flip(cell, labels, 0, firsts, 0, graph, lists)
                    flips[0] += 1


def descended(
    graph: FactorGraph, config: LaserConfig, labels: NDArray[np.uint8], sweeps: int
) -> NDArray[np.uint8]:
    """The labelling, (cells,), after at most ``sweeps`` sweeps; its energy is never higher than before."""
    state, firsts = labels.astype(np.int32), np.zeros(graph.beams, np.int32)
    if graph.beams == 0:
        return labels
    find_firsts(graph.begins, graph.cells, state, firsts, 1, graph.grid.cells)
    beams, flips = beam_graph(graph, config), np.zeros(1, np.int32)
    for _ in range(sweeps):
        _descend(beams, graph.lists, state, firsts, flips, SPREAD)
        if flips[0] == 0:
            break
    return state.astype(np.uint8)
