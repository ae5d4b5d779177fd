"""Sampling of labels by Metropolis-Hastings, the flips that it makes, and the inverse sensor model that its
heat map follows.

A flip of one cell is judged (eq. 16) by the beams that cross it alone. For a labelling, the first occupied
step of every beam is kept, which is all that its energy depends on. A flip before it or at it changes a
beam's energy, and only freeing the first one itself makes it look further along the beam. Several labellings
may be kept at once, one behind the other: a labelling's cells begin at ``base`` and its beams at
``beam_base``.

Metropolis-Hastings (section IV, Alg. 1) runs with and without a heat map. A proposal flips one cell and is
accepted with the ratio of the probabilities, for which only the beams that cross the cell are looked at (eq.
16).

Parallel are independent chains, each of which is the sequential algorithm as it stands: detailed balance
holds for every one of them, and their marginals may be averaged. Cells are drawn with fixed weights, which do
not depend on the labels, so the heat map's proposals are as symmetric as eq. 15's. Random numbers depend on a
seed, a stream and a counter alone, whichever thread asks for them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import CellLists, FactorGraph
from taichi_mrf.factor_graph.potentials import UNITS, BeamGraph, beam_graph, to_units
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, I32Array, I64Array, Template


@ti.kernel
def _count_ends(begins: I32Array, cells: I32Array, hits: I32Array, ends: I32Array):
    """Count into ``ends`` (cells) the beams with a return that end in each cell.

    ``begins`` (beams + 1), ``cells`` (edges) and ``hits`` (beams) are those of the graph.
    """
    for f in range(begins.shape[0] - 1):
        if hits[f] == 1 and begins[f + 1] > begins[f]:
            ti.atomic_add(ends[cells[begins[f + 1] - 1]], 1)


@dataclass(frozen=True)
class InverseModel:
    """Labels and marginals, (cells,): what no beam crosses is free, at one half."""

    labels: NDArray[np.uint8]
    marginals: NDArray[np.float32]


def ends_of_beams(graph: FactorGraph) -> NDArray[np.int32]:
    """(cells,): how many beams with a return end in each cell."""
    ends = np.zeros(graph.grid.cells, np.int32)
    if graph.beams:
        _count_ends(graph.begins, graph.cells, graph.hits, ends)
    return ends


def inverse_model(graph: FactorGraph, log_odds: float) -> InverseModel:
    """A return makes its own cell more occupied by ``log_odds``, and each cell before it more free."""
    returns = ends_of_beams(graph)
    votes = 2 * returns.astype(np.int64) - graph.degrees.to_numpy()
    marginals = 1.0 / (1.0 + np.exp(np.clip(-log_odds * votes, -700, 700)))
    return InverseModel((votes > 0).astype(np.uint8), marginals.astype(np.float32))


SPREAD = 512
"""Taichi gives a CPU thread no fewer iterations of a loop at a time: one long task stands for that many."""


@ti.kernel
def find_firsts(
    begins: I32Array, cells: I32Array, labels: I32Array, firsts: I32Array, chains: I32, size: I32
):
    """Each beam's first occupied step, for each chain.

    ``begins`` (beams + 1) and ``cells`` (edges) are those of the graph, ``labels`` (chains * size) 1 for
    occupied; ``firsts`` (chains * beams) receives the steps.
    """
    beams = begins.shape[0] - 1
    for i in range(chains * beams):
        chain, f = i // beams, i % beams
        first, steps = 0, begins[f + 1] - begins[f]
        while first < steps and labels[chain * size + cells[begins[f] + first]] == 0:
            first += 1
        firsts[i] = first


@ti.func
def after_flip(
    first: I32, step: I32, occupied: I32, begin: I32, steps: I32, cells: Template, labels: Template, base: I32
) -> I32:
    """A beam's first occupied step once the cell at ``step``, now ``occupied`` or not, is flipped.

    A chain's labels begin at ``base``.
    """
    new: ti.i32 = first
    if occupied == 0:
        new = ti.min(first, step)
    elif step == first:
        new = step + 1
        while new < steps and labels[base + cells[begin + new]] == 0:
            new += 1
    return new


@ti.func
def flip_change(
    cell: I32, labels: Template, base: I32, firsts: Template, beam_base: I32, graph: Template, lists: Template
):
    """Change of the energy by flipping ``cell``, in units: a sum of integers, so the list's order is free.
    ``graph`` is a BeamGraph, ``lists`` are its CellLists."""
    occupied = labels[base + cell]
    change = ti.cast(0, ti.i64)
    for i in range(lists.begins[cell], lists.begins[cell + 1]):
        f = lists.beams[i]
        step = ti.cast(lists.steps[i], ti.i32)
        first = firsts[beam_base + f]
        if step <= first:
            beam = graph.beam(f)
            new = after_flip(first, step, occupied, beam.begin, beam.steps, graph.cells, labels, base)
            change += to_units(graph.energy_of(beam, new))
            change -= to_units(graph.energy_of(beam, first))
    return change


@ti.func
def flip(
    cell: I32, labels: Template, base: I32, firsts: Template, beam_base: I32, graph: Template, lists: Template
):
    """Flip ``cell``, and renew the first occupied steps of its beams."""
    occupied = labels[base + cell]
    for i in range(lists.begins[cell], lists.begins[cell + 1]):
        f = lists.beams[i]
        step = ti.cast(lists.steps[i], ti.i32)
        first = firsts[beam_base + f]
        if step <= first:
            begin, end = graph.begins[f], graph.begins[f + 1]
            firsts[beam_base + f] = after_flip(
                first, step, occupied, begin, end - begin, graph.cells, labels, base
            )
    labels[base + cell] = 1 - occupied


PROPOSAL, ACCEPTANCE = 0, 1
"""Purposes of a random number."""


@ti.func
def mixed(x: ti.u32) -> ti.u32:
    """A permutation of 32 bits in which each bit of ``x`` sways every other (xorshift and multiply)."""
    x ^= x >> 16
    x *= ti.u32(0x7FEB352D)
    x ^= x >> 15
    x *= ti.u32(0x846CA68B)
    x ^= x >> 16
    return x


@ti.func
def random_bits(seed: Template, stream: Template, counter: ti.i64, purpose: Template) -> ti.u32:
    """32 random bits: number ``counter`` of a stream, for one of several purposes."""
    low, high = ti.cast(counter, ti.u32), ti.cast(counter >> 32, ti.u32)
    key = mixed(mixed(ti.cast(seed, ti.u32)) + ti.cast(stream, ti.u32))
    return mixed(mixed(mixed(key + low) + high) + ti.cast(purpose, ti.u32))


@ti.func
def uniform(bits: ti.u32) -> F32:
    """24 of the bits as a number above 0, up to 1: its logarithm is finite."""
    return (ti.cast(bits >> 8, ti.f32) + 1.0) * ti.static(2.0**-24)


@dataclass(frozen=True)
class _Proposals(Bundle):
    """Rule by which cells are drawn."""

    warm: I32Array
    """(n): the cells that may be drawn, the heated ones first."""

    heated: I32
    """Number of heated cells."""

    bias: I32
    """The weight of a heated cell."""

    base_bias: I32
    """The weight of another."""

    seed: I32

    counter: ti.i64
    """The number of the first proposal."""

    number: I32
    """Number of proposals."""


@dataclass(frozen=True)
class _Chains(Bundle):
    """The states of all chains, one behind the other."""

    number: I32

    size: I32
    """Cells."""

    labels: I32Array
    """(chains * cells): 1 for occupied."""

    firsts: I32Array
    """(chains * beams): each beam's first occupied step."""

    occupied_since: I64Array
    """(chains * cells): the proposal that a cell was last occupied by."""

    occupied_for: I64Array
    """(chains * cells): proposals for which it was occupied before."""

    energies: I64Array
    """(chains): what the energy has changed by, in units."""


@kernel
def _run(graph: BeamGraph, lists: CellLists, proposals: _Proposals, chains: _Chains, spread: I32) -> None:
    """Alg. 1: make proposals in every chain. A chain stands for ``spread`` iterations of the parallel
    loop."""
    beams = graph.begins.shape[0] - 1
    for iteration in range(chains.number * spread):
        if iteration % spread == 0:
            chain = iteration // spread
            base = chain * chains.size
            heated_weight = proposals.heated * proposals.bias
            others = proposals.warm.shape[0] - proposals.heated
            weights = ti.cast(heated_weight + others * proposals.base_bias, ti.u32)
            for turn in range(proposals.number):
                now = proposals.counter + turn
                drawn = ti.cast(random_bits(proposals.seed, chain, now, PROPOSAL) % weights, ti.i32)
                place = drawn // proposals.bias
                if drawn >= heated_weight:
                    place = proposals.heated + (drawn - heated_weight) // proposals.base_bias
                cell = proposals.warm[place]
                occupied = chains.labels[base + cell]
                change = flip_change(cell, chains.labels, base, chains.firsts, chain * beams, graph, lists)
                chance = ti.log(uniform(random_bits(proposals.seed, chain, now, ACCEPTANCE)))
                if change <= 0 or chance < -ti.cast(change, ti.f32) / UNITS:
                    flip(cell, chains.labels, base, chains.firsts, chain * beams, graph, lists)
                    chains.energies[chain] += change
                    i = base + cell
                    if occupied == 1:
                        chains.occupied_for[i] += now + 1 - chains.occupied_since[i]
                    else:
                        chains.occupied_since[i] = now + 1


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
        _run(
            beam_graph(graph, config), graph.lists,
            _Proposals(self.warm, self.heated, bias, 1000, config.seed, self.counter, proposals),
            _Chains(
                config.chains, graph.grid.cells, self.state, self.firsts, self.occupied_since,
                self.occupied_for, self.changes,
            ),
            SPREAD,
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
