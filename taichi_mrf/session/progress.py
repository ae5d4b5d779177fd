"""The progress of a live run in words and figures, as the viewer shows it."""

import time
from collections import deque
from collections.abc import Callable

from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.methods.protocol import MapStatistics
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.session.replay import Replay
from taichi_mrf.viewer.messages import Status

RATE_SECONDS = 5.0
"""Seconds over which the keyframe rate is averaged."""


class Progress:
    """Makes Status messages."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._taken: deque[float] = deque()
        self._begin = clock()
        self._measured: MapStatistics | None = None

    def keyframe_taken(self) -> None:
        """Count a keyframe for the rate."""
        self._taken.append(self._clock())

    def measure(self, mapper: Mapper) -> None:
        """Measure the map's size, which takes too long for every message."""
        self._measured = mapper.map.statistics()

    def status(
        self, activity: str, share: float, replay: Replay | None, mapper: Mapper, waiting: bool
    ) -> Status:
        """``waiting``: edits wait until the present work is done."""
        if self._measured is None:
            self.measure(mapper)
        assert self._measured is not None
        states = [entry.state for entry in mapper.roster.entries.values()]
        return Status(
            activity,
            share,
            replay.number if replay else 0,
            replay.frames if replay else 0,
            states.count("on"),
            states.count("frozen"),
            self._rate(),
            self._measured.voxels,
            self._measured.bricks,
            self._measured.memory_mb,
            replay.paused if replay else False,
            replay.finished if replay else True,
            waiting or mapper.edited,
            replay.speed if replay and replay.has_pace else None,
        )

    def _rate(self) -> float:
        now = self._clock()
        while self._taken and self._taken[0] < now - RATE_SECONDS:
            self._taken.popleft()
        return len(self._taken) / max(min(RATE_SECONDS, now - self._begin), 1e-3)


def sweeping(step: InferProgress) -> tuple[str, float]:
    """A step of full inference in words, and how much of it is done."""
    done = (step.sweep - 1) * step.keyframes + step.keyframe
    sentence = f"sweeping keyframe {step.keyframe} of {step.keyframes} (sweep {step.sweep} of {step.sweeps})"
    return sentence, done / (step.sweeps * step.keyframes)
