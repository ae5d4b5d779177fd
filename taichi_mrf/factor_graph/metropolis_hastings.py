"""Metropolis-Hastings over the labels of cells (section IV, Alg. 1), with and without a heat map.

A proposal flips one cell and is accepted with the ratio of the probabilities, for which only the beams that
cross the cell are looked at (eq. 16; flips.py).

Parallel are independent chains, each of which is the sequential algorithm as it stands: detailed balance
holds for every one of them, and their marginals may be averaged. Cells are drawn with fixed weights, which
do not depend on the labels, so the heat map's proposals are as symmetric as eq. 15's.
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.flips import SPREAD, find_firsts, flip, flip_change
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.factor_graph.inverse import ends_of_beams, inverse_model
from taichi_mrf.factor_graph.potentials import (
    UNITS,
    model_kind,
    sensor_vector,
    tables,
)
from taichi_mrf.factor_graph.random_numbers import random_bits, uniform
from taichi_mrf.kernels.types import I32, AnyArray, F32Array2, I32Array, I64Array, IVec3, Template, Vec5

PROPOSAL, ACCEPTANCE = 0, 1
"""What a random number is for."""


@ti.kernel
def _run(
    begins: I32Array, cells: I32Array, hits: I32Array, model: F32Array2, shape: IVec3, sensor: Vec5,
    cell_begins: I32Array, cell_beams: I32Array, cell_steps: AnyArray,
    warm: I32Array, heated: I32, bias: I32, base_bias: I32, seed: I32, chains: I32, size: I32,
    counter: ti.i64, proposals: I32,
    labels: I32Array, firsts: I32Array, occupied_since: I64Array, occupied_for: I64Array, energies: I64Array,
    kind: Template, spread: I32,
):  # fmt: skip
    """Alg. 1: make ``proposals`` in every chain, from number ``counter`` on.

    ``warm`` lists the cells that may be drawn, the ``heated`` first ones with weight ``bias`` against
    ``base_bias``. A chain's labels and times are ``size`` apart, its energy is kept in units.
    """
    beams = begins.shape[0] - 1
    for iteration in range(chains * spread):
        if iteration % spread == 0:
            chain = iteration // spread
            base = chain * size
            heated_weight = heated * bias
            weights = heated_weight + (warm.shape[0] - heated) * base_bias
            for turn in range(proposals):
                now = counter + turn
                drawn = ti.cast(random_bits(seed, chain, now, PROPOSAL) % ti.cast(weights, ti.u32), ti.i32)
                place = drawn // bias
                if drawn >= heated_weight:
                    place = heated + (drawn - heated_weight) // base_bias
                cell = warm[place]
                occupied = labels[base + cell]
                change = flip_change(
                    cell, labels, base, firsts, chain * beams, begins, cells, hits, model, shape, sensor,
                    cell_begins, cell_beams, cell_steps, kind,
                )  # fmt: skip
                chance = ti.log(uniform(random_bits(seed, chain, now, ACCEPTANCE)))
                if change <= 0 or chance < -ti.cast(change, ti.f32) / UNITS:
                    flip(
                        cell, labels, base, firsts, chain * beams, begins, cells,
                        cell_begins, cell_beams, cell_steps,
                    )  # fmt: skip
                    energies[chain] += change
                    if occupied == 1:
                        occupied_for[base + cell] += now + 1 - occupied_since[base + cell]
                    else:
                        occupied_since[base + cell] = now + 1


class MetropolisHastings:
    """The chains' states; one iteration proposes as many flips in each as there are connected cells."""

    def __init__(self, graph: FactorGraph, config: LaserConfig) -> None:
        self.graph, self.config = graph, config
        ended = ends_of_beams(graph) > 0
        heated = ended & graph.connected if config.method == "mh-heat" else np.zeros_like(ended)
        self.warm = np.concatenate(
            [np.flatnonzero(heated), np.flatnonzero(graph.connected & ~heated)]
        ).astype(np.int32)  # fmt: skip
        self.heated = int(heated.sum())
        size, chains = graph.grid.cells, config.chains
        random = np.random.default_rng(config.seed)
        if config.start == "random":
            labels = random.integers(0, 2, (chains, size)) * graph.connected
        else:
            labels = np.tile(inverse_model(graph, config.log_odds).labels, (chains, 1))
        self.state = np.ascontiguousarray(labels.reshape(-1), np.int32)
        self.firsts = np.zeros(chains * graph.beams, np.int32)
        self.occupied_since = np.zeros(chains * size, np.int64)
        self.occupied_for = np.zeros(chains * size, np.int64)
        self.changes = np.zeros(chains, np.int64)
        self.counter = self.counted_from = 0
        if graph.beams:
            find_firsts(graph.begins, graph.cells, self.state, self.firsts, chains, size)

    def iterate(self) -> float:
        """As many proposals as there are cells to draw from; the share of cells that differ from before."""
        graph, config, proposals = self.graph, self.config, len(self.warm)
        if proposals == 0:
            return 0.0
        before = self.state.copy()
        bias = max(1, round(1000 * config.heat_bias))
        lists = graph.lists
        _run(
            *tables(graph), sensor_vector(graph, config), lists.begins, lists.beams, lists.steps,
            self.warm, self.heated, bias, 1000, config.seed, config.chains, graph.grid.cells,
            self.counter, proposals, self.state, self.firsts, self.occupied_since, self.occupied_for,
            self.changes, model_kind(graph, config), SPREAD,
        )  # fmt: skip
        self.counter += proposals
        return float((before != self.state).sum()) / (proposals * config.chains)

    def forget(self) -> None:
        """Count the marginals from here on."""
        self.counted_from = self.counter
        self.occupied_for.fill(0)
        self.occupied_since.fill(self.counter)

    def labels(self) -> NDArray[np.uint8]:
        """(cells,): the present state of the chain whose energy has fallen the most."""
        states = self.state.reshape(self.config.chains, -1)
        return states[int(self.changes.argmin())].astype(np.uint8)

    def marginals(self) -> NDArray[np.float32]:
        """(cells,): the share of the time that a cell was occupied, over all chains."""
        times = self.occupied_for + self.state * (self.counter - self.occupied_since)
        spent = max(1, self.counter - self.counted_from) * self.config.chains
        shares = times.reshape(self.config.chains, -1).sum(axis=0) / spent
        return np.where(self.graph.connected, shares, 0.5).astype(np.float32)
