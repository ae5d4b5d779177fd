"""Updates of tuning that wait for the page: which of them take each other's place."""

from collections.abc import Callable, Hashable

from taichi_mrf.live.outbox import Outbox, WaitingBricks
from taichi_mrf.viewer.messages import Hello, Keyframe, Update
from taichi_mrf.viewer.tune_messages import Activity, Chosen, HeldOutView, Pinned, Residuals, Tried, Tuning

LATEST_ONLY = (Tuning, Activity, Pinned, Chosen, Residuals, HeldOutView)


class TuneOutbox(Outbox):
    """An outbox that knows the tries. A new map takes the place of the one before, but the tries stay."""

    def _key(self, update: Update) -> Hashable:
        if isinstance(update, Tuning):  # the tries on the frames before mean nothing any more
            self._keep(lambda waiting: not isinstance(waiting, (*LATEST_ONLY, Tried)))
        if isinstance(update, LATEST_ONLY):
            return type(update).__name__
        if isinstance(update, Tried):
            return "try", update.number
        return super()._key(update)

    def _forget_the_map(self) -> None:
        self._keep(lambda waiting: not isinstance(waiting, Keyframe | Hello | WaitingBricks))

    def _keep(self, wanted: Callable[[object], bool]) -> None:
        for key in [key for key, waiting in self._waiting.items() if not wanted(waiting)]:
            del self._waiting[key]
