"""How beams are dealt out to threads."""

from dataclasses import dataclass

from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.kernels.bundles import Bundle
from taichi_mrf.kernels.types import I32
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti

SCRATCH_BYTES = 256 << 20
"""Most scratch on a GPU, of two values for each step of a worker's present beam."""


@dataclass(frozen=True)
class BeamWorkers(Bundle):
    """Workers that take a part of all beams each."""

    number: I32

    spread: I32
    """Iterations of the parallel loop that a worker stands for."""

    longest: I32
    """Steps of the longest beam: a worker's part of the scratch."""

    @ti.func
    def begin(self, worker: I32, first: I32, end: I32):
        """Start of a worker's part of first .. end; it ends where the next worker's starts."""
        return first + ti.cast(ti.cast(end - first, ti.i64) * worker // self.number, ti.i32)


def beam_workers(graph: FactorGraph) -> BeamWorkers:
    """Workers for the backend that runs."""
    if runtime.active() == "cpu":
        # Taichi gives a CPU thread no fewer than 512 iterations of a loop at a time.
        return BeamWorkers(64, 512, graph.longest)
    most = SCRATCH_BYTES // (8 * graph.longest)
    return BeamWorkers(max(256, min(65536, most, graph.beams)), 1, graph.longest)
