"""Dual decomposition, by subgradients and by block-coordinate ascent.

Subgradients (section V-B, Alg. 2) prove the bound. Each beam is a slave that minimises its own energy plus
multipliers (eq. 23): one number t for each edge, what occupied costs this beam more than free. If a cell's
multipliers sum to zero, every labelling of the whole graph costs the same with them as without, so the sum of
the slaves' minima is a lower bound of the least energy. In a cell on which slaves disagree, Alg. 2 charges
each of them the step for its own choice,

    t_if += step / (r + 1)      where the slave labels it occupied, and -= where free

(``charge: whole``). Where opinions are even that is the subgradient of the bound, projected onto multipliers
that sum to zero, up to a common offset; but where one beam of a thousand disagrees, all the others are turned
against their labels. The projected subgradient itself (``charge: mean``) is

    t_if += step / (r + 1) * (x_i^f - mean over f of x_i^f)

Eq. 24 then picks the label for which a disagreeing cell's slaves have been charged the most.

Multipliers are integers of 1 / UNITS. What a cell's sum lacks to zero, by rounding or by whole charges, is
known exactly and counts as a slave of its own, of that cell alone: the bound is exact with either rule. What
rounding left goes back into the multipliers at the next step.

Block-coordinate ascent goes in the manner of MPLP, and the bound never falls. Beside the multipliers t, each
cell keeps the rest r, minus the sum of its multipliers, as a slave of its own; the bound is the sum of the
slaves' minima and of min(0, r). One iteration does two things to all beams at once, neither of which lowers
it:

    gather   each beam takes the d-th part of the rest of a cell that d beams cross;
    give     with M_i what occupied then costs more than free in cell i, min-marginal of the whole beam, it
             gives back M_i / m for each of its m contested cells, on whose label the beams do not agree.

Giving all of one cell's M would leave the sum of the beam's minimum and of the cell's own unchanged; giving
the m-th part of each is the mean of m such steps, and a minimum of linear functions is concave.

Everything is whole units here too, so the bound is exact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import BeamWorkers, FactorGraph, beam_workers
from taichi_mrf.factor_graph.potentials import GAUSSIAN, UNITS, Beam, BeamGraph, beam_graph
from taichi_mrf.inference.first_occupied import left_alone, message, next_ahead, next_behind
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, I32Array, I64Array, Template


@ti.func
def units32(value: ti.f32) -> I32:
    """An energy in whole units, as the judge counts it."""
    return ti.cast(ti.round(value * UNITS), ti.i32)


@ti.func
def solve_slave(graph: Template, beam: Beam, multipliers: Template):
    """(value, step of the first occupied cell) of a beam's least energy with its multipliers, in units.

    Behind its first occupied cell, whatever has a negative multiplier is occupied.
    """
    behind = units32(graph.energy_of_none(beam))
    alone = ti.cast(0, ti.i64)
    first: ti.i32 = beam.steps
    for back in range(beam.steps):
        step = beam.steps - 1 - back
        t = multipliers[beam.begin + step]
        cell = 0
        if ti.static(graph.kind == GAUSSIAN):
            cell = graph.cells[beam.begin + step]
        here = units32(graph.energy_of_first(beam, step, cell))
        if here + ti.max(0, t) < behind + ti.max(0, -t):
            first = step
        behind = next_behind(behind, here, t, False)
        alone += left_alone(t, False)
    return behind + alone, first


@kernel
def _solve_slaves(
    graph: BeamGraph, multipliers: I32Array, awake: I32Array, firsts: I32Array, values: I64Array,
    ones: I32Array, sums: I64Array,
) -> None:  # fmt: skip
    """Eq. 23 for every beam whose multipliers have changed; count each cell's ones, and sum the values.

    ``multipliers`` (edges) and ``values`` (beams), the slaves' minima, are in units; ``awake`` (beams) is 1
    for a beam to be solved; ``firsts`` (beams) receives the first occupied step, ``ones`` (cells) how many
    slaves label the cell occupied, ``sums[0]`` the change of the sum of values.
    """
    for f in range(graph.begins.shape[0] - 1):
        if awake[f] == 1:
            beam = graph.beam(f)
            value, first = solve_slave(graph, beam, multipliers)
            ti.atomic_add(sums[0], value - values[f])
            values[f] = value
            firsts[f] = first
        first_edge = graph.begins[f] + firsts[f]
        for edge in range(first_edge, graph.begins[f + 1]):
            if edge == first_edge or multipliers[edge] < 0:
                ti.atomic_add(ones[graph.cells[edge]], 1)


@ti.kernel
def _choose_steps(
    ones: I32Array, degrees: I32Array, rest: I64Array, charged: I64Array, step: ti.f32,
    if_free: I32Array, if_occupied: I32Array, sums: I64Array, whole: Template,
):  # fmt: skip
    """Growth of each cell's multipliers where a slave labels it free (``if_free``), and where occupied
    (``if_occupied``). All arrays are (cells), but ``sums`` (3); values are in units.

    ``ones`` of a cell's ``degrees`` slaves label it occupied. ``rest`` is minus the sum of a cell's
    multipliers; ``charged`` what slaves were charged for occupied less what they were for free (eq. 24).
    sums[1] is the value of the rest's own slaves, sums[2] counts disagreeing cells.
    """
    for cell in range(ones.shape[0]):
        yes, all_of_them = ones[cell], degrees[cell]
        if_free[cell] = 0
        if_occupied[cell] = 0
        ti.atomic_add(sums[1], ti.min(ti.cast(0, ti.i64), rest[cell]))
        if 0 < yes < all_of_them:
            mean, back = ti.cast(yes, ti.f32) / all_of_them, ti.cast(rest[cell], ti.f32) / all_of_them
            down = ti.cast(ti.round(back - step * UNITS * mean), ti.i32)
            up = ti.cast(ti.round(back + step * UNITS * (1.0 - mean)), ti.i32)
            if ti.static(whole):
                up = ti.cast(ti.round(step * UNITS), ti.i32)
                down = -up
            if_free[cell] = down
            if_occupied[cell] = up
            rest[cell] -= ti.cast(up, ti.i64) * yes + ti.cast(down, ti.i64) * (all_of_them - yes)
            charged[cell] += ti.cast(step * UNITS, ti.i64) * (2 * yes - all_of_them)
            ti.atomic_add(sums[2], ti.cast(1, ti.i64))


@ti.kernel
def _change_multipliers(
    begins: I32Array, cells: I32Array, firsts: I32Array, if_free: I32Array, if_occupied: I32Array,
    multipliers: I32Array, awake: I32Array,
):  # fmt: skip
    """Take the step in every cell on which slaves disagree, and mark the beams that it concerns.

    Arrays as in :func:`_solve_slaves` and :func:`_choose_steps`; ``begins`` (beams + 1) and ``cells`` (edges)
    are those of the graph.
    """
    for f in range(begins.shape[0] - 1):
        first_edge = begins[f] + firsts[f]
        concerned = 0
        for edge in range(begins[f], begins[f + 1]):
            cell = cells[edge]
            if if_occupied[cell] != 0 or if_free[cell] != 0:
                t = multipliers[edge]
                occupied = edge == first_edge or (edge > first_edge and t < 0)
                multipliers[edge] = t + (if_occupied[cell] if occupied else if_free[cell])
                concerned = 1
        awake[f] = concerned


class DualDecomposition:
    """Multipliers and the slaves' last labels; one iteration of Alg. 2 at a time."""

    def __init__(self, graph: FactorGraph, config: LaserConfig) -> None:
        self.graph, self.config = graph, config
        self.multipliers = ti.ndarray(ti.i32, max(1, graph.edges))
        beams, cells = graph.beams, graph.grid.cells
        self.awake, self.firsts = np.ones(beams, np.int32), np.zeros(beams, np.int32)
        self.values = np.zeros(beams, np.int64)
        self.ones, self.if_free, self.if_occupied = (np.zeros(cells, np.int32) for _ in range(3))
        self.rest, self.charged = np.zeros(cells, np.int64), np.zeros(cells, np.int64)
        self.slaves_value = 0
        self.iteration = 0
        self.dual = -np.inf

    def iterate(self) -> float:
        """Solve the slaves, note the bound, take a step; returns the share of cells in disagreement."""
        graph, sums = self.graph, np.zeros(3, np.int64)
        self.ones.fill(0)
        _solve_slaves(
            beam_graph(graph, self.config), self.multipliers, self.awake, self.firsts, self.values, self.ones,
            sums,
        )  # fmt: skip
        step = self.config.step / (self.iteration + 1)
        _choose_steps(
            self.ones, graph.degrees, self.rest, self.charged, step, self.if_free, self.if_occupied, sums,
            self.config.charge == "whole",
        )  # fmt: skip
        _change_multipliers(
            graph.begins, graph.cells, self.firsts, self.if_free, self.if_occupied, self.multipliers,
            self.awake,
        )  # fmt: skip
        self.slaves_value += int(sums[0])
        self.dual = max(self.dual, (self.slaves_value + int(sums[1])) / UNITS)
        self.iteration += 1
        return int(sums[2]) / max(1, int(graph.connected.sum()))

    def labels(self) -> NDArray[np.uint8]:
        """(cells,): what the slaves agree on, and else eq. 24."""
        degrees = self.graph.degrees.to_numpy()
        agreed = (self.ones == 0) | (self.ones == degrees)
        return np.where(agreed, (self.ones > 0), self.charged > 0).astype(np.uint8)


NEVER = 2**29
"""Stands for an infinite cost, in units; far above every energy, and its double still fits 32 bits."""

MOST_GIVEN = 4000 * int(UNITS)
"""A beam gives no more than this at once; less than all is as good, and multipliers stay within 32 bits."""


@dataclass(frozen=True)
class _Found(Bundle):
    """Findings of an iteration, summed up over all beams."""

    given: I64Array
    """(cells): what beams give back."""

    marginal: I64Array
    """(cells): the sum of their min-marginals."""

    want_free: I32Array
    """(cells): 1 where a beam asks for free."""

    want_occupied: I32Array
    """(cells): 1 where one asks for occupied."""

    bound: I64Array
    """(1): the sum of the slaves' minima after gathering."""


@kernel
def _gather_and_give(
    graph: BeamGraph, multipliers: I32Array, share: I32Array, contested: I32Array, found: _Found,
    scratch: I32Array, workers: BeamWorkers,
) -> None:  # fmt: skip
    """One iteration over all beams. All values are in units.

    ``multipliers`` (edges) are changed; ``share`` (cells) is what each beam takes of a cell's rest;
    ``contested`` (cells) is 1 where beams want different labels; ``scratch`` is (workers * longest).
    """
    for iteration in range(workers.number * workers.spread):
        if iteration % workers.spread == 0:
            worker = iteration // workers.spread
            trace = worker * workers.longest
            beams = graph.begins.shape[0] - 1
            for f in range(workers.begin(worker, 0, beams), workers.begin(worker + 1, 0, beams)):
                beam = graph.beam(f)
                ahead = NEVER
                open_cells = 0
                alone = ti.cast(0, ti.i64)
                for step in range(beam.steps):
                    edge = beam.begin + step
                    cell = graph.cells[edge]
                    t = multipliers[edge] + share[cell]
                    multipliers[edge] = t
                    open_cells += contested[cell]
                    scratch[trace + step] = ahead
                    here = units32(graph.energy_of_first(beam, step, cell))
                    # Nothing behind a cell that is surely occupied depends on how sure it is.
                    ahead = ti.max(-NEVER, next_ahead(ahead, here, t, False))
                    alone += left_alone(t, False)
                behind = units32(graph.energy_of_none(beam))
                for back in range(beam.steps):
                    step = beam.steps - 1 - back
                    edge = beam.begin + step
                    cell = graph.cells[edge]
                    t = multipliers[edge]
                    here = units32(graph.energy_of_first(beam, step, cell))
                    both = t + message(scratch[trace + step], here, behind, False)
                    if both < 0:
                        found.want_occupied[cell] = 1
                    elif both > 0:
                        found.want_free[cell] = 1
                    ti.atomic_add(found.marginal[cell], ti.cast(both, ti.i64))
                    if contested[cell] == 1:
                        # Towards zero: a beam that gave a unit too much could lower the bound.
                        gift = ti.min(MOST_GIVEN, ti.abs(both)) // open_cells
                        if both < 0:
                            gift = -gift
                        multipliers[edge] = t - gift
                        ti.atomic_add(found.given[cell], ti.cast(gift, ti.i64))
                    behind = next_behind(behind, here, t, False)
                ti.atomic_add(found.bound[0], behind + alone)


class BlockAscent:
    """Multipliers and rests; one iteration over all beams at a time."""

    def __init__(self, graph: FactorGraph, config: LaserConfig) -> None:
        self.graph, self.config = graph, config
        self.workers = beam_workers(graph)
        self.scratch = ti.ndarray(ti.i32, self.workers.number * graph.longest)
        self.multipliers = ti.ndarray(ti.i32, max(1, graph.edges))
        cells = graph.grid.cells
        self.degrees = np.maximum(graph.degrees.to_numpy(), 1).astype(np.int64)
        # On the device: what a kernel leaves untouched of a NumPy array is undefined on Vulkan.
        self.given, self.sums, self.bound = (ti.ndarray(ti.i64, n) for n in (cells, cells, 1))
        self.want_free, self.want_occupied = ti.ndarray(ti.i32, cells), ti.ndarray(ti.i32, cells)
        self.rest, self.marginal = np.zeros(cells, np.int64), np.zeros(cells, np.int64)
        self.contested = np.ones(cells, np.int32)
        self.dual = -np.inf

    def iterate(self) -> float:
        """Gather, note the bound, give; returns the share of cells on which beams do not agree."""
        graph = self.graph
        share = np.sign(self.rest) * np.minimum(np.abs(self.rest) // self.degrees, MOST_GIVEN)
        self.rest -= share * graph.degrees.to_numpy()
        found = _Found(self.given, self.sums, self.want_free, self.want_occupied, self.bound)
        for array in (self.given, self.sums, self.bound, self.want_free, self.want_occupied):
            array.fill(0)
        _gather_and_give(
            beam_graph(graph, self.config), self.multipliers, share.astype(np.int32), self.contested, found,
            self.scratch, self.workers,
        )  # fmt: skip
        self.marginal = self.sums.to_numpy()
        self.dual = max(
            self.dual, (int(self.bound.to_numpy()[0]) + int(np.minimum(self.rest, 0).sum())) / UNITS
        )
        self.rest += self.given.to_numpy()
        self.contested = self.want_free.to_numpy() & self.want_occupied.to_numpy()
        return float(self.contested.sum()) / max(1, int(graph.connected.sum()))

    def labels(self) -> NDArray[np.uint8]:
        """(cells,): 1 where occupied costs the beams less in sum."""
        return (self.marginal < 0).astype(np.uint8)
