"""viser's server, made safe and quiet: the only place where the viewer opens a port.

viser listens on all addresses, asks nobody where they come from and prints as it goes. Here the socket is
ours, every request passes `origin.py` before it becomes a websocket, and every message passes `guard.py`.
viser has no place to hang these in, so its call of websockets'
``serve`` is replaced while it starts; if viser does not start in the way that this file knows, it is
stopped again.
"""

import asyncio
import http
import logging
import operator
import os
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from errno import EADDRINUSE
from functools import cache, partial
from types import MethodType, SimpleNamespace
from typing import Any, NoReturn, get_type_hints

import rich
import viser
import websockets.asyncio.server
from viser._assignable_props_api import AssignablePropsBase
from viser._messages import ShareUrlDisconnect, ShareUrlRequest
from viser.infra import _infra as viser_infra
from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer.transport.connection import CLOSE_TIMEOUT_S, GuardedConnection
from taichi_mrf.viewer.transport.guard import Gate
from taichi_mrf.viewer.transport.origin import Pages, answer_page, refusal, unknown_name

PORTS_TO_TRY = 100
"""From the port that was asked for upwards."""

LARGEST_PICTURE = 32 * 2**20
"""Bytes; no client's message may be larger."""

VISER_INTERNALS: dict[str, type] = {
    "_websock_server._live_connections": dict,
    "_websock_server._client_state_from_id": dict,
    "_websock_server._server_thread": threading.Thread,
    "gui._gui_input_handle_from_uuid": dict,
    "gui._command_handle_from_uuid": dict,
    "gui._resolve_container_handle": MethodType,
    "scene._handle_from_node_name": dict,
    "scene._active_transform_drag_handles": dict,
    "scene._owner_id": str,
}
"""What the guard reads of a server, and its type."""

LOGGER = logging.getLogger("taichi_mrf.viewer")
LOGGER.addHandler(logging.NullHandler())

_PATCHING = threading.RLock()
"""Held while something of viser's surroundings is replaced."""

Handler = Callable[[ServerConnection], Awaitable[None]]


@cache
def _property_types(props: type) -> dict[str, Any]:
    """The types of a scene node's or widget's properties."""
    return get_type_hints(props)


# viser works them out anew for each node, which took two thirds of the time of drawing a keyframe.
AssignablePropsBase._prop_hints = property(lambda self: _property_types(type(self._impl.props)))  # type: ignore


def start_server(host: str, port: int, title: str) -> viser.ViserServer:
    """A running server that is bound to ``host`` alone, shows ``title`` and prints nothing.

    ``port`` is where the search for a free one begins, 0 takes any; the one taken is ``get_port()``.
    Raises ViewerError where ``host`` is not an address of this machine, where no port is free, and
    where viser is not the version that this guard was written for.
    """
    listener = _listen(host, port)
    door = _Door(listener, host)
    try:
        with _PATCHING, _muted(threading.current_thread()), _replaced_serve(door):
            server = _QuietServer(host=host, port=listener.getsockname()[1], label=title, verbose=False)
    except BaseException:
        listener.close()
        raise
    surprise = door.surprise or _surprise_in(server)
    if surprise:
        server.stop()
        listener.close()
        raise ViewerError(f"cannot guard viser {viser.__version__}: {surprise}; install viser 1.1")
    server._event_loop.set_exception_handler(_log_quietly)
    for share_message in (ShareUrlRequest, ShareUrlDisconnect):
        server._websock_server.unregister_handler(share_message)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    door.gate = Gate(server)
    return server


class _QuietServer(viser.ViserServer):
    """viser's server without its last words and without the way out to the public."""

    def stop(self) -> None:
        with _PATCHING, _muted(self._websock_server._server_thread):
            super().stop()

    def request_share_url(self, verbose: bool = True) -> NoReturn:
        raise ViewerError("the viewer is never shared through a public server; use an ssh tunnel")


class _Door:
    """Stands in for websockets' ``serve`` when viser calls it: same server, our socket, checked requests.

    ``gate`` is set when the server is complete; until then nobody is let in. ``surprise`` says what viser
    did differently from what is known here, and then nobody is let in either.
    """

    def __init__(self, listener: socket.socket, host: str) -> None:
        self.gate: Gate | None = None
        self.surprise: str | None = "it does not call websockets' serve"
        self._listener = listener
        self._host = host

    def serve(self, *args: Any, **options: Any) -> websockets.asyncio.server.serve:
        """Raises nothing: viser would wait for ever for a server that failed to start."""
        handler: Any = args[0] if args else None
        pages: Any = options.pop("process_request", None)
        known = callable(handler) and callable(pages) and "create_connection" not in options
        self.surprise = None if known else "it calls websockets' serve in another way"
        options |= {"max_size": LARGEST_PICTURE, "max_queue": 4, "close_timeout": CLOSE_TIMEOUT_S}
        return websockets.asyncio.server.serve(
            partial(self._welcome, handler),
            sock=self._listener,
            process_request=partial(self._answer, pages),
            create_connection=GuardedConnection,
            logger=LOGGER,
            **options,
        )

    def _answer(self, pages: Pages, connection: ServerConnection, request: Request) -> Response | None:
        """A page, a refusal, or None to go on with the websocket's handshake."""
        if self.gate is None:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "The viewer is starting.\n")
        response = answer_page(connection, request, pages)
        if response is None:
            reason = refusal(request.headers, self._host)
        else:
            reason = unknown_name(request.headers, self._host)
        if reason is None:
            return response
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"Refused: {reason}.\n")

    async def _welcome(self, handler: Handler, connection: GuardedConnection) -> None:
        """Hand a connection to viser. The stock client shows what 1002 means: reload the page; viser
        would print it as well."""
        if connection.subprotocol != f"viser-v{viser.__version__}" or self.gate is None:
            reason = f"Version mismatch. Server: {viser.__version__}"
            await connection.close(CloseCode.PROTOCOL_ERROR, reason)
            return
        connection.gate = self.gate
        await handler(connection)


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


@contextmanager
def _replaced_serve(door: _Door) -> Iterator[None]:
    """viser finds ``door.serve`` where it looks for websockets' ``serve``; nobody else does."""
    server_module = SimpleNamespace(**vars(websockets.asyncio.server) | {"serve": door.serve})
    original = viser_infra.websockets
    stand_in = SimpleNamespace(**vars(original) | {"asyncio": SimpleNamespace(server=server_module)})
    viser_infra.websockets = stand_in  # type: ignore[assignment]
    try:
        yield
    finally:
        viser_infra.websockets = original


@contextmanager
def _muted(thread: threading.Thread | None) -> Iterator[None]:
    """What ``thread`` says through rich.print is not heard; viser has no switch for some of it."""
    original = rich.print

    def print_for_others(*args: Any, **options: Any) -> None:
        if threading.current_thread() is not thread:
            original(*args, **options)

    rich.print = print_for_others
    try:
        yield
    finally:
        rich.print = original


def _surprise_in(server: viser.ViserServer) -> str | None:
    """Which of :data:`VISER_INTERNALS` is not there."""
    for name, kind in VISER_INTERNALS.items():
        try:
            found = operator.attrgetter(name)(server)
        except AttributeError:
            return f"it has no {name}"
        if not isinstance(found, kind):
            return f"its {name} is of another type"
    return None


def _log_quietly(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """What goes wrong in viser's event loop; asyncio would print a traceback."""
    LOGGER.warning("%s", context["message"], exc_info=context.get("exception"))
