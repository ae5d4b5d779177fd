"""The viewer's process: the page on its main thread, and a thread that listens to the mapper.

It is spawned by whoever maps, and ends when told to or when that process is gone.
"""

import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Protocol

import viser

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.messages import Listening, Notice, Quit, Request
from taichi_mrf.viewer.transport.inbox import Inbox
from taichi_mrf.viewer.transport.server import start_server

TITLE = "taichi_mrf"


class AnyPage(Protocol):
    """What owns the scene and the widgets: of live, or of tune."""

    inbox: Inbox

    def run(self) -> None:
        """Serve until None is put into the inbox."""


def run_viewer(
    connection: "Connection[Any, Any]",
    host: str,
    port: int,
    new_page: Callable[[viser.ViserServer, Callable[[Request], None]], AnyPage] = Page,
) -> None:
    """Serve the page until the mapper says Quit or is gone.

    The first message back is Listening, or a Notice that says why there is no page. ``new_page`` makes the
    page, given the server and what sends a request to the mapper.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the mapper hears it too, and says when to end
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        server = start_server(host, port, TITLE)
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
    threading.Thread(target=_listen, args=(connection, page), daemon=True, name="listener").start()
    try:
        page.run()
    finally:
        server.stop()


def _listen(connection: "Connection[Any, Any]", page: AnyPage) -> None:
    """Put what the mapper says into the page's inbox, to the end."""
    try:
        while True:
            update = connection.recv()
            if isinstance(update, Quit):
                break
            page.inbox.put(update)
    except (EOFError, OSError):
        pass
    page.inbox.put(None)
