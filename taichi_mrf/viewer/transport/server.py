"""viser's server, made safe and quiet: the only place where the viewer opens a port.

viser listens on all addresses, accepts requests from any page and prints as it goes. Here the socket is ours,
every request passes `origin.py` before it becomes a websocket, and every message passes `guard.py`. viser has
no hook for these, so its call of websockets' ``serve`` is replaced while it starts; if viser does not start
in the way that is known here, it is stopped again.
"""

import asyncio
import http
import logging
import os
import socket
from collections.abc import Awaitable, Callable
from errno import EADDRINUSE
from functools import partial
from typing import Any, NoReturn

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer.transport import viser_internals as internals
from taichi_mrf.viewer.transport.connection import CLOSE_TIMEOUT_S, LARGEST_PICTURE, GuardedConnection
from taichi_mrf.viewer.transport.guard import Gate
from taichi_mrf.viewer.transport.origin import Pages, answer_page, refusal, unknown_name
from taichi_mrf.viewer.transport.pulse import PATH, Pulse

PORTS_TO_TRY = 100
"""From the port that was asked for upwards."""

MOST_CLIENTS = 64
"""Browsers that may be connected at the same time."""

LOGGER = logging.getLogger("taichi_mrf.viewer")
LOGGER.addHandler(logging.NullHandler())

Handler = Callable[[ServerConnection], Awaitable[None]]


def start_server(host: str, port: int, title: str, pulse: Pulse | None = None) -> viser.ViserServer:
    """A running server that is bound to ``host`` alone, shows ``title`` and prints nothing.

    ``port`` is where the search for a free one begins, 0 takes any; the one taken is ``get_port()``.
    ``pulse`` says whether the mapping process still speaks; without it there is none.
    Raises ViewerError if ``host`` is not an address of this machine, if no port is free, and if viser is
    not the version that this guard was written for.
    """
    internals.with_nonce(internals.PAGE.read_text("utf-8"), nonce="")
    listener = _listen(host, port)
    door = _Door(listener, host, pulse or Pulse())
    try:
        with internals.serving_by(door.serve):
            server = _QuietServer(host=host, port=listener.getsockname()[1], label=title, verbose=False)
    except BaseException:
        listener.close()
        raise
    changes = [door.surprise] if door.surprise else internals.changes_in(server, internals.SERVER)
    if changes:
        server.stop()
        listener.close()
        raise ViewerError(
            f"cannot guard viser {viser.__version__}: {'; '.join(changes)}; install viser "
            f"{internals.KNOWN_VERSION}, or mend {internals.HERE}"
        )
    internals.set_exception_handler(server, _log_quietly)
    internals.forbid_sharing(server)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    door.gate = Gate(server)
    return server


class _QuietServer(viser.ViserServer):
    """viser's server, which prints nothing when it stops and opens no public tunnel."""

    def stop(self) -> None:
        with internals.muted(internals.server_thread(self)):
            super().stop()

    def request_share_url(self, verbose: bool = True) -> NoReturn:
        raise ViewerError("the viewer is never shared through a public server; use an ssh tunnel")


class _Door:
    """Stands in for websockets' ``serve`` when viser calls it: same server, our socket, checked requests.

    ``gate`` is set when the server is complete; until then every client is refused. ``surprise`` says what
    viser did differently from what is known here; then every client is refused, too.
    """

    def __init__(self, listener: socket.socket, host: str, pulse: Pulse) -> None:
        self.gate: Gate | None = None
        self.surprise: str | None = "it does not call websockets' serve"
        self._listener = listener
        self._host = host
        self._pulse = pulse
        self._clients = 0

    def serve(self, *args: Any, **options: Any) -> websockets.asyncio.server.serve:
        """Raises nothing: viser would wait forever for a server that failed to start."""
        handler: Any = args[0] if args else None
        pages: Any = options.pop("process_request", None)
        known = callable(handler) and callable(pages) and "create_connection" not in options
        self.surprise = None if known else "it calls websockets' serve in another way"
        options |= {"max_size": LARGEST_PICTURE, "max_queue": 4, "close_timeout": CLOSE_TIMEOUT_S}
        return websockets.asyncio.server.serve(
            partial(self._welcome, handler),
            sock=self._listener,
            process_request=partial(self._answer, partial(self._pages, pages)),
            create_connection=GuardedConnection,
            logger=LOGGER,
            **options,
        )

    def _pages(self, pages: Pages, connection: ServerConnection, request: Request) -> Response | None:
        """Response to a request: viser's, or the pulse."""
        if request.path.partition("?")[0] == PATH:
            return self._pulse.answer(connection)
        return pages(connection, request)

    def _answer(self, pages: Pages, connection: ServerConnection, request: Request) -> Response | None:
        """A page, a refusal, or None to go on with the websocket's handshake."""
        if self.gate is None:
            response = connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "The viewer is starting.\n")
            response.headers["Refresh"] = "1"  # a browser asks again by itself
            return response
        page = answer_page(connection, request, pages)
        if page is None:
            reason = refusal(request.headers, self._host)
        else:
            reason = unknown_name(request.headers, self._host)
        if reason is None:
            return page
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"Refused: {reason}.\n")

    async def _welcome(self, handler: Handler, connection: GuardedConnection) -> None:
        """Hand a connection to viser. The stock client shows what 1002 means: reload the page; viser
        would print it as well."""
        if connection.subprotocol != f"viser-v{viser.__version__}" or self.gate is None:
            reason = f"Version mismatch. Server: {viser.__version__}"
            await connection.close(CloseCode.PROTOCOL_ERROR, reason)
            return
        if self._clients >= MOST_CLIENTS:
            await connection.close(
                CloseCode.TRY_AGAIN_LATER, f"{MOST_CLIENTS} browsers are connected already"
            )
            return
        connection.gate = self.gate
        self._clients += 1
        try:
            await handler(connection)
        finally:
            self._clients -= 1


def _listen(host: str, port: int) -> socket.socket:
    """A socket that listens on ``host`` and the first free port from ``port`` on."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise ViewerError(f"cannot listen on {host!r}: no such address") from error
    family, address = min((each[0], each[4][0]) for each in found)
    ports = [0] if port == 0 else range(port, min(port + PORTS_TO_TRY, 65536))
    for each in ports:
        try:
            return socket.create_server((str(address), each), family=family)
        except (OSError, OverflowError) as error:
            if getattr(error, "errno", None) != EADDRINUSE:
                reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else error
                raise ViewerError(f"cannot listen on {host} port {each}: {reason}") from error
    raise ViewerError(f"cannot listen on {host}: no port from {port} on is free")


def _log_quietly(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error in viser's event loop; asyncio would print a traceback."""
    LOGGER.warning("%s", context["message"], exc_info=context.get("exception"))
