"""Settling a map step by step: rounds of alignment (rounds.py) and full inference.

Whoever settles a map takes one step after the other, and may do other work in between: a batch run reports
its progress, a live run carries out requests.

    with FullInference(m) as settling:
        for step in settling:
            if is_to_stop(step):
                settling.stop()
    settling.outcome

A stop is treated in one way everywhere. It never leaves a map that lacks the evidence of some keyframes,
unless there is no time:

- What stopped rounds have moved goes back.
- What full inference has computed stays once each keyframe was swept.
- Before that, the map goes back to what it was if a copy was kept. A live run keeps one, because it shows
  that map meanwhile. Without a copy, as in a batch run, the first sweep is completed.
"""

from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any, Generic, TypeVar

from taichi_mrf.inference.schedule import InferProgress, InferReport, StopRequestedError, driven
from taichi_mrf.methods.capabilities import has_messages
from taichi_mrf.methods.protocol import OccupancyMap

StepT = TypeVar("StepT")
OutcomeT = TypeVar("OutcomeT")
SettlingT = TypeVar("SettlingT", bound="Settling[Any, Any]")


class Settling(Generic[StepT, OutcomeT]):
    """An iterator over steps that can be stopped. Leaving its ``with`` block ends it."""

    def __init__(self, steps: Generator[StepT, None, OutcomeT]) -> None:
        self._steps = steps
        self._stop: StopRequestedError | None = None
        self.outcome: OutcomeT | None = None
        """Outcome of the work, once there are no more steps."""

    def stop(self, at_once: bool = False) -> None:
        """Stop after the step taken last. More follow only to leave a whole map, and none if ``at_once``."""
        self._stop = StopRequestedError(at_once)

    def run(self) -> OutcomeT:
        """Take all steps, and return the outcome."""
        self.outcome = driven(self._steps)
        return self.outcome

    def __iter__(self) -> Iterator[StepT]:
        return self

    def __next__(self) -> StepT:
        stop, self._stop = self._stop, None
        try:
            return next(self._steps) if stop is None else self._steps.throw(stop)
        except StopIteration as end:
            self.outcome = end.value
            raise

    def __enter__(self: SettlingT) -> SettlingT:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._steps.close()


class FullInference(Settling[InferProgress, InferReport | None]):
    """Full inference over all keyframes of a map. The outcome is None if the map went back to what it was."""

    def __init__(self, m: OccupancyMap, sweeps: int | None = None, keep_before: bool = False) -> None:
        """``sweeps`` overrides the configuration's. ``keep_before``: keep a copy of the map to show
        meanwhile, and, if it has messages, to go back to if inference is stopped early or fails."""
        self._map = m
        self._kept = (m, m.checkpoint()) if keep_before and has_messages(m) else None
        self._before = m.view.pool.snapshot() if keep_before and self._kept is None else None
        super().__init__(self._inferring(sweeps))

    def showing_before(self) -> AbstractContextManager[None]:
        """While the block runs, all queries and files show the map as it was before, with ``keep_before``."""
        if self._kept is not None:
            return self._kept[0].showing(self._kept[1])
        assert self._before is not None, "no copy was kept"
        return self._map.view.pool.showing(self._before)

    def _inferring(self, sweeps: int | None) -> Generator[InferProgress, None, InferReport | None]:
        steps = self._map.infer_steps(sweeps=sweeps)
        stays = False
        try:
            step = next(steps)
            while True:
                try:
                    yield step
                except StopRequestedError as stop:
                    all_swept = step.sweep > 1 or step.keyframe == step.keyframes
                    stays = all_swept or self._kept is None
                    ends = all_swept or self._kept is not None or stop.at_once
                    step = steps.throw(stop) if ends else next(steps)
                else:
                    step = next(steps)
        except StopIteration as end:
            report: InferReport = end.value
            stays = stays or report.complete
            return report if stays else None
        finally:
            steps.close()
            if not stays and self._kept is not None:
                self._kept[0].restore(self._kept[1])
