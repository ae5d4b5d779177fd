"""Division of a keyframe's rays, or groups of rays, among workers: runs of neighbours, which cross the same
bricks."""

from dataclasses import dataclass

from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, Template


@dataclass(frozen=True)
class Workers(Bundle):
    """The number of workers, and the rays that each takes."""

    number: I32
    """Workers; each has its own part of the trace."""

    run: I32
    """Neighbouring rays that a worker takes at a time."""

    spread: I32
    """Iterations of the parallel loop that a worker stands for."""

    block: Template
    """Threads in a block on a GPU; 0 leaves it to Taichi."""

    def strides(self, longest: int) -> tuple[int, int]:
        """Strides of a trace with ``longest`` steps for each worker (ray_model.Trace). On a processor a
        worker's steps are side by side; on a GPU those of all workers, which write at the same time."""
        return (1, self.number) if runtime.on_gpu() else (longest, 1)

    @ti.func
    def turns(self, rays: I32):
        """Number of rays that each worker is dealt, those beyond the last included."""
        runs = (rays + self.run - 1) // self.run
        return (runs + self.number - 1) // self.number * self.run

    @ti.func
    def ray(self, worker: I32, turn: I32):
        """The ray of a worker's turn. It may lie beyond the last."""
        return (turn // self.run * self.number + worker) * self.run + turn % self.run


def workers_for(arch: str, software: bool, longest: int, trace_bytes: int) -> Workers:
    """Workers for a backend, whose traces hold ``longest`` voxels of ``trace_bytes`` each.

    On a CPU a worker takes runs of rays, and its trace stays in the cache; on a GPU it is a thread,
    neighbours take neighbouring rays, and the trace is bounded to a GB.
    """
    if arch == "cpu":
        # Taichi gives a CPU thread no fewer than 512 iterations of a loop at a time.
        return Workers(64, 16, 512, 0)
    if software:
        return Workers(1024, 1, 1, runtime.SOFTWARE_BLOCK)
    most = (1 << 30) // (trace_bytes * longest)
    return Workers(max(256, min(65536, most)), 1, 1, 128)


def workers_without_trace() -> Workers:
    """Workers of the backend that runs, for rays that leave no trace."""
    return workers_for(runtime.active() or "cpu", runtime.is_software(), 1, 1)
