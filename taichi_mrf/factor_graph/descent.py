"""Descent: flip every cell whose flip lowers the energy, until none does.

What belief propagation and dual decomposition leave undecided is rounded cell by cell, which may leave
labellings that a single flip improves. Cells are taken in the order of their numbers, one after the other.
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.flips import SPREAD, find_firsts, flip, flip_change
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.factor_graph.potentials import model_kind, sensor_vector, tables
from taichi_mrf.kernels.types import I32, AnyArray, F32Array2, I32Array, IVec3, Template, Vec5


@ti.kernel
def _descend(
    begins: I32Array, cells: I32Array, hits: I32Array, model: F32Array2, shape: IVec3, sensor: Vec5,
    cell_begins: I32Array, cell_beams: I32Array, cell_steps: AnyArray,
    labels: I32Array, firsts: I32Array, kind: Template, spread: I32,
) -> ti.i32:  # fmt: skip
    """One sweep over all cells, by one thread; returns how many were flipped."""
    flips = 0
    for iteration in range(spread):
        if iteration == 0:
            for cell in range(labels.shape[0]):
                change = flip_change(
                    cell, labels, 0, firsts, 0, begins, cells, hits, model, shape, sensor,
                    cell_begins, cell_beams, cell_steps, kind,
                )  # fmt: skip
                if change < 0:
                    flip(cell, labels, 0, firsts, 0, begins, cells, cell_begins, cell_beams, cell_steps)
                    flips += 1
    return flips


def descended(
    graph: FactorGraph, config: LaserConfig, labels: NDArray[np.uint8], sweeps: int
) -> NDArray[np.uint8]:
    """The labelling, (cells,), after at most ``sweeps`` sweeps; its energy is never higher than before."""
    state, firsts = labels.astype(np.int32), np.zeros(graph.beams, np.int32)
    if graph.beams == 0:
        return labels
    find_firsts(graph.begins, graph.cells, state, firsts, 1, graph.grid.cells)
    lists = graph.lists
    for _ in range(sweeps):
        flips = _descend(
            *tables(graph), sensor_vector(graph, config), lists.begins, lists.beams, lists.steps, state,
            firsts, model_kind(graph, config), SPREAD,
        )  # fmt: skip
        if flips == 0:
            break
    return state.astype(np.uint8)
