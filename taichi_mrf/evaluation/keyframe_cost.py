"""Cost of a new keyframe in a live map, stage by stage, in seconds of the clock and of the processors.

On a machine that runs other programs too, wall-clock time is of little use; the CPU time, all threads
of the process together, still does.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from taichi_mrf import Frame, MRFMap
from taichi_mrf.inference.schedule import InferReport
from taichi_mrf.system.compiler import ti


@dataclass(frozen=True)
class Seconds:
    """A duration in wall-clock (``wall``) and in CPU time, of all threads (``cpu``)."""

    wall: float
    cpu: float

    def __add__(self, other: "Seconds") -> "Seconds":
        return Seconds(self.wall + other.wall, self.cpu + other.cpu)

    @staticmethod
    def median(of: "Sequence[Seconds]") -> "Seconds":
        """The median of each of the two."""
        return Seconds(statistics.median(s.wall for s in of), statistics.median(s.cpu for s in of))

    @staticmethod
    def mean(of: "Sequence[Seconds]") -> "Seconds":
        """The mean of each of the two."""
        return Seconds(statistics.mean(s.wall for s in of), statistics.mean(s.cpu for s in of))


@dataclass(frozen=True)
class KeyframeCost:
    """Cost of one new keyframe.

    ``allocate`` chooses its rays, finds out which bricks they cross and makes those that are missing;
    ``own_sweep`` sends its messages; ``reinference`` sweeps those again to whom that was news, of whom there
    were ``swept_again``.
    """

    allocate: Seconds
    own_sweep: Seconds
    reinference: Seconds
    swept_again: int

    @property
    def alone(self) -> Seconds:
        """Without re-inference of others."""
        return self.allocate + self.own_sweep

    @property
    def whole(self) -> Seconds:
        """All three stages."""
        return self.alone + self.reinference


def timed(call: Callable[[], object]) -> Seconds:
    """Time of a call, until the device has finished it."""
    ti.sync()
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    ti.sync()
    return Seconds(time.perf_counter() - wall, time.process_time() - cpu)


def live_stages(m: MRFMap, frame: Frame) -> dict[str, Callable[[], object]]:
    """The stages of a new keyframe by their names in :class:`KeyframeCost`, to be called in this order.

    ``reinference`` returns the report of :meth:`MRFMap.renew`. The keyframe's own sweep is one of
    :meth:`MRFMap.infer`, which leaves all that concerns others to the last stage; ``renew([keyframe])`` does
    both at once.
    """
    added: list[int] = []
    parts = (frame.depth_m, frame.T_world_camera, frame.camera, frame.name, frame.stamp)

    def renew() -> InferReport:
        report = m.renew()
        m.view.pool.belief  # noqa: B018 (a dated map brings it up to date when it is read)
        return report

    return {
        "allocate": lambda: added.append(m.add_keyframe(*parts)),
        "own_sweep": lambda: m.infer(sweeps=1, keyframes=added),
        "reinference": renew,
    }


def add_timed(m: MRFMap, frame: Frame) -> KeyframeCost:
    """Add a frame to a map as a live run does, and time it."""
    results: list[Any] = []
    times = {}
    for name, stage in live_stages(m, frame).items():
        times[name] = timed(lambda: results.append(stage()))  # noqa: B023
    return KeyframeCost(**times, swept_again=results[-1].sweeps)


def warm_up(m: MRFMap, frames: Sequence[Frame]) -> None:
    """Have all kernels compiled that a live map needs, on a map that is not needed for anything else."""
    for frame in frames[:2]:
        for stage in live_stages(m, frame).values():
            stage()
    # Twice as many sweeps as keyframes: each has then been told something new, and has new bricks to look at.
    m.renew(tolerance=0.0, progress=lambda done: done.keyframe < 4)
    ti.sync()
