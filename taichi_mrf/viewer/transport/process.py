"""The viewer's process: a page on its main thread, a thread that reads what the mapping process sends, and
the page's inbox.

The mapping process starts it. It ends on Quit, and when the mapping process has ended. Updates come into the
inbox from the mapping process, events from the browsers; None ends the page, whose own thread takes them out.
viser runs callbacks on a pool of threads: a callback only puts an event into the inbox.
"""

import os
import queue
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from multiprocessing.connection import Connection
from typing import Any, Protocol

import viser

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer.messages import Alive, Listening, Notice, Quit, Request, Update
from taichi_mrf.viewer.transport.pulse import Pulse
from taichi_mrf.viewer.transport.server import start_server


class Event:
    """Base of what a user or a browser does; the pages add their own."""


@dataclass(frozen=True)
class Joined(Event):
    """A browser has connected."""

    client: int


@dataclass(frozen=True)
class OptionsMoved(Event):
    """A widget of the view options was used; the latest values count."""


@dataclass(frozen=True)
class Used(Event):
    """A client used the widget of an action: it pressed the button, or changed the value."""

    action: Enum
    client: int


Item = Update | Event | None


class Inbox:
    """A queue that any thread may fill."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Item] = queue.SimpleQueue()

    def put(self, item: Item) -> None:
        """Add one item; returns at once."""
        self._queue.put(item)

    def wait(self, patience_s: float | None) -> list[Item]:
        """All items in the queue. Waits for the first one for at most ``patience_s`` seconds (None: without
        limit), and returns an empty list if none has come by then."""
        try:
            batch = [self._queue.get(timeout=patience_s)]
        except queue.Empty:
            return []
        while not self._queue.empty():
            batch.append(self._queue.get())
        return batch


TITLE = "taichi_mrf"


class AnyPage(Protocol):
    """The live page or the tuning page."""

    inbox: Inbox

    def run(self) -> None:
        """Serve until None is put into the inbox."""


NewPage = Callable[[viser.ViserServer, Callable[[Request], None]], AnyPage]
"""Makes a page from the server and the function that sends a request to the mapping process."""


def run_viewer(connection: "Connection[Any, Any]", host: str, port: int, new_page: NewPage) -> None:
    """Serve a page until the mapping process sends Quit or ends.

    The first message back is Listening, or a Notice that says why there is no page.
    """
    # The mapping process gets these signals too, and tells this one when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    pulse = Pulse(os.getppid())
    try:
        server = start_server(host, port, TITLE, pulse)
    except ViewerError as error:
        connection.send(Notice(str(error), "error"))
        return
    lock = threading.Lock()

    def ask(request: Request) -> None:
        with lock:
            try:
                connection.send(request)
            except OSError:
                page.inbox.put(None)

    page = new_page(server, ask)
    ask(Listening(server.get_host(), server.get_port()))
    threading.Thread(target=_read, args=(connection, page, pulse), daemon=True, name="reader").start()
    try:
        page.run()
    finally:
        server.stop()


def _read(connection: "Connection[Any, Any]", page: AnyPage, pulse: Pulse) -> None:
    """Put all updates into the page's inbox until the connection ends."""
    try:
        while True:
            pulse.heard()
            update = connection.recv()
            if isinstance(update, Quit):
                break
            if not isinstance(update, Alive):
                page.inbox.put(update)
    except (EOFError, OSError):
        pass
    page.inbox.put(None)
