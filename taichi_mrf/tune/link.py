"""The line to the tuning page's process."""

import signal
from multiprocessing.connection import Connection

from taichi_mrf.live.link import ViewerLink
from taichi_mrf.tune.outbox import TuneOutbox
from taichi_mrf.viewer.messages import Request, Update


def start_page(host: str, port: int) -> ViewerLink:
    """Start the page's process; use what comes back as a context."""
    return ViewerLink(host, port, _serve_page, TuneOutbox())


class NoPage:
    """A line with nobody at its other end, for runs without a page."""

    lost: str | None = None

    def send(self, update: Update) -> None:
        """Nobody hears it."""

    def requests(self) -> list[Request]:
        """Nobody asks for anything."""
        return []

    def wait(self, timeout: float) -> None:
        """There is nothing to wait for."""


def _serve_page(connection: Connection, host: str, port: int) -> None:
    """What runs in the page's process. Imported late: its libraries are of no use to mapping."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from taichi_mrf.viewer.transport.process import run_viewer
    from taichi_mrf.viewer.tune.page import TunePage

    run_viewer(connection, host, port, TunePage)
