"""The connection to the viewer, a separate process that shows the page.

The viewer is spawned, never forked: a fork of a process in which Taichi runs hangs. Sending never waits: one
thread writes the outbox to the pipe. Requests are read between two pieces of mapping.
"""

import atexit
import multiprocessing
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Protocol

from taichi_mrf.session.outbox import Outbox
from taichi_mrf.system.libraries import installed
from taichi_mrf.viewer.messages import Notice, Quit, Request, Update

GOODBYE_SECONDS = 0.5
"""How long the viewer may take to end by itself, before it is terminated."""

FORCE_SECONDS = 0.1
"""How long it may take after each signal."""

MOST_REQUESTS = 1000
"""Most requests that are read at once, so that a flood of them cannot keep the session from working."""

Serve = Callable[[Connection, str, int], None]
"""The main function of a viewer's process: its end of the connection, host and port."""


class Link(Protocol):
    """Interface of the connection to a session's viewer."""

    @property
    def lost(self) -> str | None:
        """Reason the viewer disconnected; None while connected."""
        ...

    def send(self, update: Update) -> None:
        """Send an update; never waits, and does nothing once the viewer has disconnected."""
        ...

    def requests(self) -> list[Request]:
        """The requests that have come since the last call; never waits."""
        ...

    def wait(self, timeout: float) -> None:
        """Wait until there is a request, the link is lost, or ``timeout`` seconds have passed."""
        ...


class ViewerLink:
    """A viewer process and the connection to it. Use it as a context, or :meth:`close` it."""

    def __init__(
        self, host: str, port: int, serve: Serve | None = None, outbox: Outbox | None = None
    ) -> None:
        """Start the viewer; its first request will be Listening. ``serve`` is the process's main function,
        by default the live page's; ``outbox`` decides which updates replace each other. Raises
        ModuleNotFoundError here, and not in that process, if the library of pages is missing."""
        if not installed("viser"):
            raise ModuleNotFoundError("No module named 'viser'", name="viser")
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe(duplex=True)
        self._process = context.Process(
            target=serve or _serve_page, args=(theirs, host, port), name="taichi-mrf viewer", daemon=True
        )
        with _interrupts_ignored(), _main_left_alone():
            self._process.start()
        # Runs before multiprocessing's own exit handler, which sends SIGTERM, and waits without end for a
        # process that ignores it.
        atexit.register(self.close)
        theirs.close()  # so that the connection ends with their process
        self._outbox = Outbox() if outbox is None else outbox
        self._lost: str | None = None
        self._received: list[Request] = []
        self._sender = threading.Thread(target=self._send_all, name="viewer outbox", daemon=True)
        self._sender.start()

    @property
    def lost(self) -> str | None:
        """Reason the viewer disconnected; None while connected."""
        if self._lost is None and not self._process.is_alive():
            self._read()  # its last message may give the reason
            self._lost = (
                self._lost or f"the viewer's process has ended (exit status {self._process.exitcode})"
            )
        return self._lost

    def send(self, update: Update) -> None:
        """Put an update into the outbox."""
        self._outbox.put(update)

    def requests(self) -> list[Request]:
        """The requests that have come since the last call."""
        self._read()
        received, self._received = self._received, []
        return received

    def wait(self, timeout: float) -> None:
        """Wait until the viewer sends something or ends, at most ``timeout`` seconds."""
        if self.lost is None:
            wait([self._connection, self._process.sentinel], timeout)
        else:
            time.sleep(timeout)

    def ask_to_end(self) -> None:
        """Ask the viewer to end, without waiting for it; :meth:`close` waits."""
        self._outbox.close()

    def close(self) -> None:
        """End the viewer: ask it to, then terminate it, then kill it. A program that does not call this does
        so when it ends."""
        atexit.unregister(self.close)
        self.ask_to_end()
        self._process.join(GOODBYE_SECONDS)
        for end in (self._process.terminate, self._process.kill):
            if self._process.is_alive():
                end()
                self._process.join(FORCE_SECONDS)
        self._sender.join(GOODBYE_SECONDS)
        self._connection.close()

    def __enter__(self) -> "ViewerLink":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _read(self) -> None:
        """Read what has come from the viewer. Where the connection ends, so does the process; if it does
        not, that is noted here."""
        try:
            for _ in range(MOST_REQUESTS):
                if not self._connection.poll():
                    break
                request = self._connection.recv()
                if isinstance(request, Notice):  # there is no page, and this is why
                    self._lost = request.text
                else:
                    self._received.append(request)
        except (EOFError, OSError):
            self._process.join(GOODBYE_SECONDS)
            if self._process.is_alive():
                self._lost = self._lost or "the viewer has closed the connection"

    def _send_all(self) -> None:
        try:
            while not isinstance(update := self._outbox.take(), Quit):
                self._connection.send(update)
            self._connection.send(update)
        except (OSError, ValueError):  # the viewer has ended, or the connection is closed
            self._outbox.close()


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes that are started in this block ignore Ctrl-C from their first instruction on; the session
    ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    saved = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, saved)


@contextmanager
def _main_left_alone() -> Iterator[None]:
    """Processes that are started in this block do not run the program's main module again, which may be a
    user's script without a guard."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _serve_page(connection: Connection, host: str, port: int) -> None:
    """Main function of the viewer's process. Imported late: mapping needs none of the page's libraries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from taichi_mrf.viewer.live.page import Page
    from taichi_mrf.viewer.scene.base_page import run_viewer

    run_viewer(connection, host, port, Page)
