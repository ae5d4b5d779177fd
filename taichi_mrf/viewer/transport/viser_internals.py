"""All that this package uses of viser without a public name, in one place.

viser trusts its clients and has no hook to check requests or messages, so the guard must read what viser
keeps for itself. :func:`changes_in` compares it with what this file was written for, and the server does not
start if they differ; ``tests/viewer/test_viser_internals.py`` says what to mend.
"""

import operator
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import MethodType, SimpleNamespace
from typing import Any, get_type_hints

import rich
import viser
import websockets.asyncio.server
from viser._assignable_props_api import AssignablePropsBase
from viser._gui_handles import GuiModalHandle, _GuiInputHandle
from viser._messages import (
    GetRenderResponseMessage,
    GuiSliderMark,
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

PAGE = Path(viser.__file__).parent / "client" / "build" / "index.html"
"""viser's page."""

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

_PATCHING = threading.RLock()
"""Held while something that viser uses is replaced."""

_STARTS_SCRIPT = 'e.type="module"'
"""Part of viser's page that starts the script that it has unpacked."""


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


def set_ticks(slider: viser.GuiSliderHandle[float], values: Sequence[float]) -> None:
    """Draw a tick at each of some values of a slider, and numbers at its ends."""
    ends = (GuiSliderMark(end, f"{end:g}") for end in (slider.min, slider.max))
    ticks: Any = (*ends, *(GuiSliderMark(value, None) for value in values))
    if slider._marks != ticks:
        slider._marks = ticks


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


def with_nonce(page: str, nonce: str) -> str:
    """viser's page, whose scripts run under a content security policy that names ``nonce``: those in the
    file, and the one that viser unpacks and starts. Raises ViewerError if viser starts it in another way than
    is known here."""
    if page.count(_STARTS_SCRIPT) != 1 or page.count("<head>") != 1:
        raise ViewerError(
            f"cannot guard viser {viser.__version__}: its page is packed in another way; "
            f"install viser {KNOWN_VERSION}, or mend with_nonce in {HERE}"
        )
    page = page.replace("<script", f'<script nonce="{nonce}"')
    return page.replace(_STARTS_SCRIPT, f'e.nonce="{nonce}";{_STARTS_SCRIPT}')


@contextmanager
def serving_by(serve: Callable[..., Any]) -> Iterator[None]:
    """viser finds ``serve`` in place of websockets' function of this name, and prints nothing; other modules
    and threads are not affected."""
    server_module = SimpleNamespace(**vars(websockets.asyncio.server) | {"serve": serve})
    stand_in = SimpleNamespace(**vars(websockets) | {"asyncio": SimpleNamespace(server=server_module)})
    with muted(threading.current_thread()), _replaced(viser_infra, "websockets", stand_in):
        yield


@contextmanager
def muted(thread: threading.Thread | None) -> Iterator[None]:
    """Drop what ``thread`` prints through rich.print; viser has no switch for some of it."""
    original = rich.print

    def print_for_others(*args: Any, **options: Any) -> None:
        if threading.current_thread() is not thread:
            original(*args, **options)

    with _replaced(rich, "print", print_for_others):
        yield


@contextmanager
def _replaced(module: Any, name: str, stand_in: Any) -> Iterator[None]:
    """Replace something that viser uses, in one thread at a time."""
    with _PATCHING:
        original = getattr(module, name)
        setattr(module, name, stand_in)
        try:
            yield
        finally:
            setattr(module, name, original)


@cache
def _property_types(props: type) -> dict[str, Any]:
    """The types of a scene node's or widget's properties."""
    return get_type_hints(props)


# viser computes them again for each node, which took two thirds of the time of drawing a keyframe.
AssignablePropsBase._prop_hints = property(lambda self: _property_types(type(self._impl.props)))  # type: ignore
