"""Which requests may become websockets, and which files are served.

A browser lets any page open a websocket to any address, and a host name can be made to point at this machine
after a page was loaded (DNS rebinding). So the requesting page must come from the address that it connects
to, and that address must not be one that a stranger can assign.
"""

import gzip
import http
import ipaddress
import re
import secrets
import socket
from collections.abc import Callable
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from taichi_mrf.viewer.transport import pulse
from taichi_mrf.viewer.transport.viser_internals import with_nonce

PAGE_HEADERS = {"X-Frame-Options": "DENY", "X-Content-Type-Options": "nosniff"}
"""No other page may hold this one in a frame, and no browser may guess the type of a file."""

POLICY = (
    "default-src 'none'; script-src 'wasm-unsafe-eval' 'nonce-{nonce}'; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src {server} data: blob:; font-src data:; "
    "connect-src {server} data: blob:; base-uri 'none'; form-action 'none'"
)
"""The content security policy: the page runs its own scripts and no others, whatever texts it shows, and
talks to this server alone. The scripts have a nonce that is made for each answer."""

Pages = Callable[[ServerConnection, Request], Response | None]
"""Serves the client's files; None if the request is for a websocket."""

TAB_TITLE = "<title>taichi_mrf</title>"

DEFAULT_PORTS = {"http": 80, "https": 443}

_PLAIN_PATH = re.compile(r"(/[A-Za-z0-9_-][A-Za-z0-9._-]*)*/?", re.ASCII)
"""All paths of the client's build match this; none with a parent folder, percent, backslash or NUL does."""


def refusal(headers: Headers, host: str) -> str | None:
    """Why a request with these headers may not become a websocket; None if it may.

    ``host`` is the name or address that the server was asked to listen on. Works through an ssh tunnel:
    the browser puts the tunnel's port both into Host and into Origin.
    """
    origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
    if len(origins) != 1:
        return "exactly one Origin is needed"
    unknown = unknown_name(headers, host)
    if unknown is not None:
        return unknown
    try:
        origin, addressed = urlsplit(origins[0]), urlsplit(f"//{hosts[0]}")
        default_port = DEFAULT_PORTS[origin.scheme]
        from_page = (origin.hostname, origin.port or default_port)
        to_server = (addressed.hostname, addressed.port or default_port)
    except (KeyError, ValueError):
        return "the Origin cannot be read"
    if origins[0] != f"{origin.scheme}://{origin.netloc}" or "@" in origin.netloc:
        return "the Origin cannot be read"
    return None if from_page == to_server else "the page comes from another address"


def unknown_name(headers: Headers, host: str) -> str | None:
    """Why the name in the Host header is refused; None if it is a name of this machine.

    A stranger's name server can point any name at this machine, except an address, localhost, and this
    machine's own host name.
    """
    hosts = headers.get_all("Host")
    try:
        (addressed,) = (urlsplit(f"//{each}") for each in hosts)
        name, _ = addressed.hostname, addressed.port
    except ValueError:
        return "exactly one Host is needed, as name or name:port"
    if name is None or hosts[0] != addressed.netloc or "@" in addressed.netloc:
        return "the Host cannot be read"
    if _is_address(name) or name == "localhost" or name.endswith(".localhost"):
        return None
    if name in {socket.gethostname().lower(), host.lower()}:
        return None
    return "the viewer is not known by this name; use the machine's IP address, or start it with --host NAME"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def answer_page(connection: ServerConnection, request: Request, pages: Pages) -> Response | None:
    """The answer of ``pages`` to a request for a file, made safe; None if the request is for a websocket.

    Paths that are not plain never reach ``pages``. Every answer comes with :data:`PAGE_HEADERS` and
    :data:`POLICY`.
    """
    if _PLAIN_PATH.fullmatch(request.path.partition("?")[0]):
        try:
            response = pages(connection, request)
        except (LookupError, OSError, ValueError):
            response = connection.respond(http.HTTPStatus.NOT_FOUND, "Not found.\n")
        if response is None:
            return None
    else:
        response = connection.respond(http.HTTPStatus.NOT_FOUND, "Not found.\n")
    nonce = secrets.token_urlsafe(16)
    if response.headers.get("Content-Type", "").startswith("text/html"):
        response.body = _made_ours(
            bytes(response.body), nonce, response.headers.get("Content-Encoding") == "gzip"
        )
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
    policy = POLICY.format(nonce=nonce, server="'self'") + "; frame-ancestors 'none'"
    for name, value in {**PAGE_HEADERS, "Content-Security-Policy": policy}.items():
        response.headers[name] = value
    return response


def _made_ours(page: bytes, nonce: str, packed: bool) -> bytes:
    """viser's page with the project's name on the browser's tab and the script that asks for the server's
    pulse, compressed again if it is ``packed``."""
    plain = (gzip.decompress(page) if packed else page).decode()
    plain = plain.replace("<title>Viser</title>", TAB_TITLE + pulse.TAG, 1)
    ours = with_nonce(plain, nonce).encode()
    return gzip.compress(ours) if packed else ours
