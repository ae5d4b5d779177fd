"""Loopy belief propagation (section V-A): sum-product, and max-product as its limit.

A message is what occupied costs more than free, in one number for each edge, from the beam to the cell.
A cell's message to a beam is its belief, the sum of all messages to it (eqs. 18, 19), less the beam's own.
Beliefs are sums of integers, kept while messages change, so that neither the order nor the number of
threads matters.

Three schedules. All beams at once (parallel, which needs damping); beams in random order, divided into
batches of which each sees what those before it have sent; and all at once over those beams alone whose
incoming messages have changed or whose own are not yet what they should be (residual): belief propagation
over disagreeing nodes only.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import BeamWorkers, FactorGraph, beam_workers
from taichi_mrf.factor_graph.potentials import BeamGraph, beam_graph
from taichi_mrf.inference.first_occupied import NEVER, message, next_ahead, next_behind
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, F32Array2, I32Array, I64Array, Template

FINE = 2.0**20
"""Beliefs are counted in integers of 1 / FINE: exact to 1e-6, and a million beams fit 64 bits."""


@ti.func
def to_fine(value: F32) -> ti.i64:
    """The nearest whole number of 1 / FINE."""
    return ti.cast(ti.round(value * FINE), ti.i64)


@dataclass(frozen=True)
class _State(Bundle):
    """Messages and beliefs: what occupied costs more than free."""

    belief: I64Array
    """(cells), in 1 / FINE."""

    messages: F32Array
    """(edges), from a beam to a cell."""

    change: I64Array
    """(cells): what messages have changed of beliefs that is not in them yet, in 1 / FINE."""

    awake: I32Array
    """(beams): 1 for a beam whose messages are out of date."""


@kernel
def send(
    order: I32Array, begin: I32, end: I32, graph: BeamGraph, state: _State, damping: F32, tolerance: F32,
    scratch: F32Array2, workers: BeamWorkers, soft: Template,
) -> None:  # fmt: skip
    """Renew the messages of beams ``order[begin:end]`` (eqs. 17 and 20), and add what they changed up.

    A beam of which damping has held a message back by more than ``tolerance`` stays awake. ``order`` is
    (beams) or shorter; ``scratch`` (workers * longest, 2) holds the incoming messages and ``ahead``.
    """
    for iteration in range(workers.number * workers.spread):
        if iteration % workers.spread == 0:
            worker = iteration // workers.spread
            trace = worker * workers.longest
            for i in range(workers.begin(worker, begin, end), workers.begin(worker + 1, begin, end)):
                beam = graph.beam(order[i])
                ahead = NEVER
                held_back = 0.0
                for step in range(beam.steps):
                    edge = beam.begin + step
                    cell = graph.cells[edge]
                    incoming = ti.cast(state.belief[cell] - to_fine(state.messages[edge]), ti.f32) / FINE
                    scratch[trace + step, 0] = incoming
                    scratch[trace + step, 1] = ahead
                    here = graph.energy_of_first(beam, step, cell)
                    ahead = next_ahead(ahead, here, incoming, soft)
                behind = graph.energy_of_none(beam)
                for back in range(beam.steps):
                    step = beam.steps - 1 - back
                    edge = beam.begin + step
                    cell = graph.cells[edge]
                    here = graph.energy_of_first(beam, step, cell)
                    old = state.messages[edge]
                    wanted = message(scratch[trace + step, 1], here, behind, soft)
                    new = old + (1.0 - damping) * (wanted - old)
                    held_back = ti.max(held_back, ti.abs(wanted - new))
                    moved = to_fine(new) - to_fine(old)
                    if moved != 0:
                        ti.atomic_add(state.change[cell], moved)
                        state.messages[edge] = new
                    behind = next_behind(behind, here, scratch[trace + step, 0], soft)
                state.awake[order[i]] = ti.cast(held_back > tolerance, ti.i32)


@ti.kernel
def _apply(belief: I64Array, change: I64Array):
    """Add the changes to the beliefs; both (cells), in 1 / FINE."""
    for cell in range(belief.shape[0]):
        if change[cell] != 0:
            belief[cell] += change[cell]
            change[cell] = 0


@ti.func
def _clipped(belief: ti.i64, most: ti.i64) -> ti.i64:
    """A belief as far as it matters."""
    return ti.max(-most, ti.min(most, belief))


@ti.kernel
def _mark_changed(
    belief: I64Array, seen: I64Array, most: ti.i64, tolerance: ti.i64, changed: I32Array
) -> ti.i32:
    """Mark the cells whose belief has moved by more than ``tolerance`` since it was last seen.

    ``belief`` and ``seen`` are (cells) in 1 / FINE, ``changed`` (cells) receives the marks. Returns their
    number.
    """
    number = 0
    for cell in range(belief.shape[0]):
        now = _clipped(belief[cell], most)
        changed[cell] = 0
        if ti.abs(now - seen[cell]) > tolerance:
            changed[cell] = 1
            seen[cell] = now
            number += 1
    return number


@ti.kernel
def _mark_awake(begins: I32Array, cells: I32Array, changed: I32Array, awake: I32Array):
    """Mark also the beams that cross a marked cell: ``awake`` (beams), from the marks ``changed`` (cells).

    ``begins`` (beams + 1) and ``cells`` (edges) are those of the graph.
    """
    for f in range(begins.shape[0] - 1):
        edge = begins[f]
        while awake[f] == 0 and edge < begins[f + 1]:
            awake[f] = changed[cells[edge]]
            edge += 1


class BeliefPropagation:
    """Messages and beliefs, and one iteration of the chosen schedule at a time."""

    def __init__(self, graph: FactorGraph, config: LaserConfig) -> None:
        self.graph, self.config = graph, config
        self.soft = config.method == "bp"
        self.workers = beam_workers(graph)
        self.scratch = ti.ndarray(ti.f32, (self.workers.number * graph.longest, 2))
        self.messages = ti.ndarray(ti.f32, max(1, graph.edges))
        self.messages.fill(0.0)
        cells = graph.grid.cells
        self.belief, self.change, self.seen = (np.zeros(cells, np.int64) for _ in range(3))
        self.changed = np.zeros(cells, np.int32)
        # On the device: what a kernel leaves untouched of a NumPy array is undefined on Vulkan.
        self.awake = ti.ndarray(ti.i32, max(1, graph.beams))
        self.awake.fill(1)
        self.random = np.random.default_rng(config.seed)
        energies = (config.energy_explained, config.energy_free, config.energy_wrong)
        if graph.has_table:
            energies = (-graph.largest_energy, graph.largest_energy, 0.0)
        # A belief more certain than every energy and a beam's own message is as good as certain.
        self.most = int(FINE * (2 * (max(energies) - min(energies)) + 2 * 20))

    def iterate(self) -> float:
        """Renew messages once; returns the share of cells whose belief moved by more than the tolerance."""
        schedule = self.config.schedule
        if schedule == "random":
            self._send(self.random.permutation(self.graph.beams).astype(np.int32), self.config.batches)
        elif schedule == "residual":
            self._send(np.flatnonzero(self.awake.to_numpy()[: self.graph.beams]).astype(np.int32), 1)
        else:
            self._send(np.arange(self.graph.beams, dtype=np.int32), 1)
        moved = _mark_changed(
            self.belief, self.seen, self.most, int(FINE * self.config.tolerance), self.changed
        )
        if schedule == "residual":
            _mark_awake(self.graph.begins, self.graph.cells, self.changed, self.awake)
        held_back = self.config.damping > 0 and self.graph.beams > 0 and self.awake.to_numpy().any()
        return max(moved, int(held_back)) / max(1, int(self.graph.connected.sum()))

    def labels(self) -> NDArray[np.uint8]:
        """Eq. 21, (cells,): 1 where occupied costs less. What no beam crosses is free."""
        return (self.belief < 0).astype(np.uint8)

    def marginals(self) -> NDArray[np.float32]:
        """Eq. 19, (cells,): the probability of occupied, a half where no beam crosses."""
        return (1.0 / (1.0 + np.exp(np.clip(self.belief / FINE, -700, 700)))).astype(np.float32)

    def _send(self, order: NDArray[np.int32], batches: int) -> None:
        graph = self.graph
        if len(order) == 0:
            return
        size = -(-graph.beams // batches)
        for begin in range(0, len(order), size):
            send(
                order, begin, min(begin + size, len(order)), beam_graph(graph, self.config),
                _State(self.belief, self.messages, self.change, self.awake),
                self.config.damping, self.config.tolerance, self.scratch, self.workers, self.soft,
            )  # fmt: skip
            _apply(self.belief, self.change)
