"""Loopy belief propagation (section V-A): sum-product, and max-product as its limit.

A message is what occupied costs more than free, in one number for each edge, from the beam to the cell.
What a cell tells a beam is its belief, the sum of all messages to it (eqs. 18, 19), less the beam's own.
Beliefs are sums of integers, kept while messages change, so that neither the order nor the number of
threads matters.

Three schedules. All beams at once (parallel, which needs damping); beams in random order, divided into
batches of which each sees what those before it have sent; and all at once over those beams alone whose
incoming messages have changed or whose own are not yet what they should be (residual): belief propagation
over disagreeing nodes only.
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.factor_graph.potentials import (
    beam_of,
    energy_of_first,
    energy_of_none,
    model_kind,
    sensor_vector,
    tables,
)
from taichi_mrf.factor_graph.workers import Workers, share_begin
from taichi_mrf.inference.first_occupied import NEVER, message, next_ahead, next_behind
from taichi_mrf.kernels.types import F32, I32, F32Array, F32Array2, I32Array, I64Array, IVec3, Template, Vec5

FINE = 2.0**20
"""Beliefs are counted in integers of 1 / FINE: exact to 1e-6, and a million beams fit 64 bits."""


@ti.func
def to_fine(value: F32) -> ti.i64:
    """The nearest whole number of 1 / FINE."""
    return ti.cast(ti.round(value * FINE), ti.i64)


@ti.kernel
def send(
    order: I32Array, begin: I32, end: I32,
    begins: I32Array, cells: I32Array, hits: I32Array, model: F32Array2, shape: IVec3, sensor: Vec5,
    belief: I64Array, messages: F32Array, change: I64Array, damping: F32, tolerance: F32, awake: I32Array,
    scratch: F32Array2, longest: I32, workers: I32, spread: I32, kind: Template, soft: Template,
):  # fmt: skip
    """Renew the messages of beams ``order[begin:end]`` (eqs. 17 and 20), and add what they changed up.

    A beam of which damping has held a message back by more than ``tolerance`` stays awake.
    """
    for iteration in range(workers * spread):
        if iteration % spread == 0:
            worker = iteration // spread
            trace = worker * longest
            for i in range(
                share_begin(worker, workers, begin, end), share_begin(worker + 1, workers, begin, end)
            ):
                beam = beam_of(order[i], begins, hits, model, kind)
                ahead = NEVER
                held_back = 0.0
                for step in range(beam.steps):
                    edge = beam.begin + step
                    cell = cells[edge]
                    incoming = ti.cast(belief[cell] - to_fine(messages[edge]), ti.f32) / FINE
                    scratch[trace + step, 0] = incoming
                    scratch[trace + step, 1] = ahead
                    here = energy_of_first(beam, step, cell, model, sensor, shape, kind)
                    ahead = next_ahead(ahead, here, incoming, soft)
                behind = energy_of_none(beam, model, sensor, kind)
                for back in range(beam.steps):
                    step = beam.steps - 1 - back
                    edge = beam.begin + step
                    cell = cells[edge]
                    here = energy_of_first(beam, step, cell, model, sensor, shape, kind)
                    old = messages[edge]
                    wanted = message(scratch[trace + step, 1], here, behind, soft)
                    new = old + (1.0 - damping) * (wanted - old)
                    held_back = ti.max(held_back, ti.abs(wanted - new))
                    moved = to_fine(new) - to_fine(old)
                    if moved != 0:
                        ti.atomic_add(change[cell], moved)
                        messages[edge] = new
                    behind = next_behind(behind, here, scratch[trace + step, 0], soft)
                awake[order[i]] = ti.cast(held_back > tolerance, ti.i32)


@ti.kernel
def _apply(belief: I64Array, change: I64Array):
    for cell in range(belief.shape[0]):
        if change[cell] != 0:
            belief[cell] += change[cell]
            change[cell] = 0


@ti.func
def _clipped(belief: ti.i64, most: ti.i64) -> ti.i64:
    return ti.max(-most, ti.min(most, belief))


@ti.kernel
def _mark_changed(
    belief: I64Array, seen: I64Array, most: ti.i64, tolerance: ti.i64, changed: I32Array
) -> ti.i32:
    """Mark the cells whose belief has moved by more than ``tolerance`` since it was last seen."""
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
    """Mark also the beams that cross a marked cell."""
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
        self.workers = Workers(graph)
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
        # What is more certain than every energy and a beam's own message is as good as certain.
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
        graph, workers = self.graph, self.workers
        if len(order) == 0:
            return
        size = -(-graph.beams // batches)
        for begin in range(0, len(order), size):
            send(
                order, begin, min(begin + size, len(order)), *tables(graph),
                sensor_vector(graph, self.config), self.belief, self.messages, self.change,
                self.config.damping, self.config.tolerance, self.awake, workers.scratch, workers.longest,
                workers.number, workers.spread, model_kind(graph, self.config), self.soft,
            )  # fmt: skip
            _apply(self.belief, self.change)
