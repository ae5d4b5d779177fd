"""The line to the tuning page's process, and which of the updates that wait for it replace each other."""

import signal
from collections.abc import Callable, Hashable
from multiprocessing.connection import Connection

from taichi_mrf.session.link import ViewerLink
from taichi_mrf.session.outbox import Outbox, Waiting, WaitingBricks
from taichi_mrf.viewer.messages import Hello, KeyframeInfo, Request, Update
from taichi_mrf.viewer.tune import messages as t

LATEST_ONLY = (t.Tuning, t.Activity, t.Pinned, t.Chosen, t.Residuals, t.HeldOutView, t.Verdict)


class TuneOutbox(Outbox):
    """An outbox for tries: a new map replaces the one before, but the tries stay."""

    def key(self, update: Update) -> Hashable | None:
        """Every try waits in a place of its own."""
        if isinstance(update, LATEST_ONLY):
            return type(update).__name__
        if isinstance(update, t.Tried):
            return "try", update.number
        return super().key(update)

    def still_wanted(self, update: Update) -> Callable[[Waiting], bool] | None:
        """Other frames make tries pointless, another map what is of the map."""
        if isinstance(update, t.Tuning):
            return lambda waiting: not isinstance(waiting, (*LATEST_ONLY, t.Tried))
        if isinstance(update, Hello):
            return lambda waiting: not isinstance(waiting, KeyframeInfo | Hello | WaitingBricks)
        return None


def start_page(host: str, port: int) -> ViewerLink:
    """Start the page's process; use what comes back as a context."""
    return ViewerLink(host, port, _serve_page, TuneOutbox())


class NoPage:
    """The line of a run without a page: sends nothing, and nothing is asked for."""

    lost: str | None = None

    def send(self, update: Update) -> None:
        """Does nothing."""

    def requests(self) -> list[Request]:
        """No requests."""
        return []

    def wait(self, timeout: float) -> None:
        """Returns at once."""


def _serve_page(connection: Connection, host: str, port: int) -> None:
    """Main function of the page's process. Imported late: mapping needs none of its libraries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from taichi_mrf.viewer.scene.base_page import run_viewer
    from taichi_mrf.viewer.tune.page import TunePage

    run_viewer(connection, host, port, TunePage)
