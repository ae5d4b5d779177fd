"""The inverse sensor model (eqs. 4 to 6): every cell for itself, log-odds added up beam by beam."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.kernels.types import I32Array
from taichi_mrf.system.compiler import ti


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
