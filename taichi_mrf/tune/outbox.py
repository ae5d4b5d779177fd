"""Updates of tuning that wait for the page: which of them take each other's place."""

from collections.abc import Callable, Hashable

from taichi_mrf.live.outbox import Outbox, Waiting, WaitingBricks
from taichi_mrf.viewer.messages import Hello, KeyframeInfo, Update
from taichi_mrf.viewer.tune.messages import Activity, Chosen, HeldOutView, Pinned, Residuals, Tried, Tuning

LATEST_ONLY = (Tuning, Activity, Pinned, Chosen, Residuals, HeldOutView)


class TuneOutbox(Outbox):
    """An outbox that knows the tries. A new map takes the place of the one before, but the tries stay."""

    def key(self, update: Update) -> Hashable | None:
        """Every try waits in a place of its own."""
        if isinstance(update, LATEST_ONLY):
            return type(update).__name__
        if isinstance(update, Tried):
            return "try", update.number
        return super().key(update)

    def still_wanted(self, update: Update) -> Callable[[Waiting], bool] | None:
        """Other frames make tries pointless, another map what is of the map."""
        if isinstance(update, Tuning):
            return lambda waiting: not isinstance(waiting, (*LATEST_ONLY, Tried))
        if isinstance(update, Hello):
            return lambda waiting: not isinstance(waiting, KeyframeInfo | Hello | WaitingBricks)
        return None
