"""Dual decomposition by block-coordinate ascent, in the manner of MPLP: the bound never falls.

Beside the multipliers t of dual_decomposition.py, each cell keeps the rest r, minus the sum of its
multipliers, as a slave of its own; the bound is the sum of the slaves' minima and of min(0, r). One
iteration does two things to all beams at once, neither of which lowers it:

    gather   each beam takes the d-th part of the rest of a cell that d beams cross;
    give     with M_i what occupied then costs more than free in cell i, min-marginal of the whole beam, it
             gives back M_i / m for each of its m contested cells, on whose label the beams do not agree.

Giving all of one cell's M would leave the sum of the beam's minimum and of the cell's own unchanged; giving
the m-th part of each is the mean of m such steps, and a minimum of linear functions is concave.

Everything is whole units, as in dual_decomposition.py, so the bound is exact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.dual_decomposition import units32
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.factor_graph.potentials import UNITS, BeamGraph, beam_graph
from taichi_mrf.factor_graph.workers import BeamWorkers, beam_workers
from taichi_mrf.inference.first_occupied import left_alone, message, next_ahead, next_behind
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.types import I32Array, I64Array
from taichi_mrf.system.compiler import ti

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
        self.multipliers.fill(0)
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
