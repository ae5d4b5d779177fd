"""The viewer's process: a page on its main thread, and a thread that reads what the mapping process sends.

The mapping process starts it. It ends on Quit, and when the mapping process has ended.
"""

import os
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Protocol

import viser

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer.messages import Alive, Listening, Notice, Quit, Request
from taichi_mrf.viewer.transport.inbox import Inbox
from taichi_mrf.viewer.transport.pulse import Pulse
from taichi_mrf.viewer.transport.server import start_server

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
