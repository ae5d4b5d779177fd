"""How beams are dealt out to threads, and the scratch that each of them needs."""

import taichi as ti

from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.kernels.types import I32
from taichi_mrf.system import runtime

SCRATCH_BYTES = 256 << 20
"""Most scratch on a GPU."""


class Workers:
    """``number`` workers take every ``number``-th beam each; ``spread`` loop iterations stand for one.

    ``scratch`` (number * longest, 2) float32 holds two values for each step of a worker's present beam.
    """

    def __init__(self, graph: FactorGraph) -> None:
        if runtime.active() == "cpu":
            # Taichi gives a CPU thread no fewer than 512 iterations of a loop at a time.
            self.number, self.spread = 64, 512
        else:
            most = SCRATCH_BYTES // (8 * graph.longest)
            self.number, self.spread = max(256, min(65536, most, graph.beams)), 1
        self.longest = graph.longest
        self.scratch = ti.ndarray(ti.f32, (self.number * self.longest, 2))


@ti.func
def share_begin(worker: I32, workers: I32, begin: I32, end: I32) -> I32:
    """Where a worker's part of begin .. end begins; it ends where the next worker's does."""
    return begin + ti.cast(ti.cast(end - begin, ti.i64) * worker // workers, ti.i32)
