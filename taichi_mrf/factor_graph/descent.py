"""Descent: flip every cell whose flip lowers the energy, until none does.

What belief propagation and dual decomposition leave undecided is rounded cell by cell, which may leave
labellings that a single flip improves. Cells are taken in the order of their numbers, one after the other.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.flips import SPREAD, find_firsts, flip, flip_change
from taichi_mrf.factor_graph.graph import CellLists, FactorGraph
from taichi_mrf.factor_graph.potentials import BeamGraph, beam_graph
from taichi_mrf.kernels.bundles import kernel
from taichi_mrf.kernels.types import I32, I32Array


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
