"""All that this package uses of viser without a public name, in one place.

viser trusts its clients and has no hook to check requests or messages, so the guard must read what viser
keeps for itself. :func:`changes_in` compares it with what this file was written for, and the server does not
start if they differ; ``tests/viewer/test_viser_internals.py`` says what to mend.
"""

import base64
import hashlib
import operator
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import MethodType, SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import rich
import viser
import websockets.asyncio.server
import zstandard
from viser._assignable_props_api import AssignablePropsBase
from viser._gui_handles import GuiModalHandle, _GuiInputHandle
from viser._messages import (
    GetRenderResponseMessage,
    GuiUpdateMessage,
    ShareUrlDisconnect,
    ShareUrlRequest,
)
from viser.infra import ClientId
from viser.infra import _infra as viser_infra
from websockets.asyncio.server import ServerConnection

from taichi_mrf.errors import ViewerError

HERE = "taichi_mrf/viewer/transport/viser_internals.py"
KNOWN_VERSION = "1.1"

Widget = _GuiInputHandle[Any]
"""A widget with a value; clients may not write all of them."""

SERVER: dict[str, type] = {
    "_event_loop": object,
    "_websock_server._live_connections": dict,
    "_websock_server._client_state_from_id": dict,
    "_websock_server._server_thread": threading.Thread,
    "_websock_server.unregister_handler": MethodType,
    "gui._gui_input_handle_from_uuid": dict,
    "gui._command_handle_from_uuid": dict,
    "gui._resolve_container_handle": MethodType,
    "scene._handle_from_node_name": dict,
    "scene._active_transform_drag_handles": dict,
    "scene._owner_id": str,
}
"""Attributes that are read of a server, and their types."""

WIDGET: dict[str, type] = {
    "_impl.gui_api": viser.GuiApi,
    "_impl.parent_container_id": str,
    "_impl.is_button": bool,
    "_impl.uuid": str,
    "_impl.props": object,
}
"""Attributes that are read of a widget."""

CLIENT: dict[str, type] = {"_websock_connection._incoming_handlers": dict}
"""Attributes that are read of a client."""

TAB: dict[str, type] = {"_parent": viser.GuiTabGroupHandle}
"""Attributes that are read of a tab."""

_PATCHING = threading.RLock()
"""Held while something that viser uses is replaced."""


def changes_in(thing: Any, expected: Mapping[str, type]) -> list[str]:
    """Which attributes of ``thing`` are not as ``expected``, each in a sentence."""
    kind, found = type(thing).__name__, []
    for name, wanted in expected.items():
        try:
            value = operator.attrgetter(name)(thing)
        except AttributeError:
            found.append(f"{kind} has no {name}")
            continue
        if not isinstance(value, wanted):
            found.append(f"{kind}.{name} is of the type {type(value).__name__}, not {wanted.__name__}")
    return found


def connections(server: viser.ViserServer) -> Mapping[int, ServerConnection]:
    """The open websockets by the number of their client."""
    return server._websock_server._live_connections


def server_thread(server: viser.ViserServer) -> threading.Thread | None:
    """The thread of the event loop."""
    return server._websock_server._server_thread


def set_exception_handler(server: viser.ViserServer, handler: Callable[..., None]) -> None:
    """Give the event loop a handler of its uncaught exceptions."""
    server._event_loop.set_exception_handler(handler)


def forbid_sharing(server: viser.ViserServer) -> None:
    """No client may ask for a public tunnel any more."""
    for message in (ShareUrlRequest, ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)


def tell_value(server: viser.ViserServer, client: int, uuid: str, value: Any) -> None:
    """Tell one client alone which value a widget has."""
    state = server._websock_server._client_state_from_id.get(client)
    if state is not None:
        state.message_buffer.push(GuiUpdateMessage(uuid, {"value": value}))


def awaits_picture(server: viser.ViserServer, client: int) -> bool:
    """True if this client was asked for a picture and has not sent it."""
    handle = server.get_clients().get(client)
    return handle is not None and bool(
        handle._websock_connection._incoming_handlers.get(GetRenderResponseMessage)
    )


def guis(server: viser.ViserServer, client: int) -> Iterator[viser.GuiApi]:
    """Places of a client's widgets: everybody's page, and its own."""
    yield server.gui
    handle = server.get_clients().get(client)
    if handle is not None:
        yield handle.gui


def input_widget(server: viser.ViserServer, client: int, uuid: str) -> Widget | None:
    """The widget of this name on the client's page."""
    found = (gui._gui_input_handle_from_uuid.get(uuid) for gui in guis(server, client))
    return next((widget for widget in found if widget is not None), None)


def has_command(server: viser.ViserServer, client: int, uuid: str) -> bool:
    """True if the client's page has a command of this name."""
    return any(uuid in gui._command_handle_from_uuid for gui in guis(server, client))


def is_button(widget: Widget) -> bool:
    """True if a widget is a button, which has no value to correct."""
    return widget._impl.is_button


def can_be_used(widget: Widget) -> bool:
    """True if a person could use it: enabled, and shown together with all that it lies in."""
    if widget.disabled or not widget.visible:
        return False
    gui, uuid = widget._impl.gui_api, widget._impl.parent_container_id
    while uuid != "root":
        try:
            container: Any = gui._resolve_container_handle(uuid)
        except KeyError:
            return False
        if isinstance(container, viser.GuiTabHandle):
            container = container._parent
        if isinstance(container, GuiModalHandle):
            return True
        if not container.visible:
            return False
        if isinstance(container, viser.Gui3dContainerHandle | viser.PanelHandle):
            return True
        uuid = container._impl.parent_container_id
    return True


def scene_of(server: viser.ViserServer, client: int, owner: str) -> viser.SceneApi | None:
    """The shared scene (owner ""), or the client's own; None for the scene of another client."""
    if owner == "":
        return server.scene
    handle = server.get_clients().get(client)
    return handle.scene if handle is not None and handle.scene._owner_id == owner else None


def node(scene: viser.SceneApi, name: str) -> viser.SceneNodeHandle | None:
    """The node of this name."""
    return scene._handle_from_node_name.get(name)


def holds_gizmo(scene: viser.SceneApi, client: int, name: str) -> bool:
    """True if this client is dragging the gizmo of this name."""
    return (ClientId(client), name) in scene._active_transform_drag_handles


@cache
def page_script_hashes() -> tuple[str, ...]:
    """The scripts of viser's page as sources of a content security policy: the one in the file, and the one
    that it unpacks and starts. Raises ViewerError if the page is packed in another way than is known here."""
    path = Path(viser.__file__).parent / "client" / "build" / "index.html"
    try:
        page = path.read_text("utf-8")
        (head, outer) = re.findall(r"<script([^>]*)>(.*?)</script>", page, re.DOTALL)[0]
        packed, styles, code = re.fullmatch(
            r' data-p="([^"]*)" data-ss="(\d+)" data-cs="(\d+)"', head
        ).groups()  # type: ignore[union-attr]
        alphabet = re.search(r'const A="((?:[^"\\]|\\.)*)"', outer)[1].replace("\\\\", "\\")  # type: ignore[index]
        unpacked = zstandard.ZstdDecompressor().decompress(
            _from_text(packed, alphabet), max_output_size=int(styles) + int(code)
        )
    except (OSError, LookupError, ValueError, AttributeError, TypeError, zstandard.ZstdError) as error:
        raise ViewerError(
            f"cannot guard viser {viser.__version__}: its page is packed in another way ({error}); "
            f"install viser {KNOWN_VERSION}, or mend page_script_hashes in {HERE}"
        ) from error
    inner = unpacked[int(styles) : int(styles) + int(code)]
    digests = (hashlib.sha256(script).digest() for script in (outer.encode(), inner))
    return tuple(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)


def _from_text(packed: str, alphabet: str) -> bytes:
    """Bytes that were written as digits to the base of the alphabet's length, five for each four bytes."""
    value_of = np.zeros(128, np.int64)
    value_of[[ord(c) for c in alphabet]] = np.arange(len(alphabet))
    digits = value_of[np.frombuffer(packed.encode("ascii"), np.uint8)]
    whole, rest = divmod(len(digits), 5)
    powers = np.array([len(alphabet) ** k for k in (4, 3, 2, 1, 0)])
    words = (digits[: 5 * whole].reshape(whole, 5) @ powers).astype(">u4").tobytes()
    last = 0
    for digit in digits[5 * whole :].tolist():
        last = last * len(alphabet) + digit
    return words + last.to_bytes(rest - 1, "big") if rest else words


@contextmanager
def serving_by(serve: Callable[..., Any]) -> Iterator[None]:
    """viser finds ``serve`` in place of websockets' function of this name, and prints nothing; other modules
    and threads are not affected."""
    server_module = SimpleNamespace(**vars(websockets.asyncio.server) | {"serve": serve})
    with _PATCHING, muted(threading.current_thread()):
        original = viser_infra.websockets
        stand_in = SimpleNamespace(**vars(original) | {"asyncio": SimpleNamespace(server=server_module)})
        viser_infra.websockets = stand_in  # type: ignore[assignment]
        try:
            yield
        finally:
            viser_infra.websockets = original


@contextmanager
def muted(thread: threading.Thread | None) -> Iterator[None]:
    """Drop what ``thread`` prints through rich.print; viser has no switch for some of it."""
    with _PATCHING:
        original = rich.print

        def print_for_others(*args: Any, **options: Any) -> None:
            if threading.current_thread() is not thread:
                original(*args, **options)

        rich.print = print_for_others
        try:
            yield
        finally:
            rich.print = original


@cache
def _property_types(props: type) -> dict[str, Any]:
    """The types of a scene node's or widget's properties."""
    return get_type_hints(props)


# viser computes them again for each node, which took two thirds of the time of drawing a keyframe.
AssignablePropsBase._prop_hints = property(lambda self: _property_types(type(self._impl.props)))  # type: ignore
