"""What of a client's words reaches viser, and in which form: the gate behind the websocket.

viser trusts its clients: any of them may write any property of any widget, upload files and open a public
tunnel. Here a message passes only if it speaks of something that exists, is shown and can be used, and it
passes with values that its widget could have sent.
"""

import math
from collections.abc import Iterator
from typing import Any

import msgspec
import viser
from viser._gui_handles import GuiModalHandle
from viser._messages import GetRenderResponseMessage, GuiUpdateMessage
from viser.infra import ClientId
from websockets.asyncio.server import ServerConnection

from taichi_mrf.viewer.transport.client_messages import (
    AnyClientMessage,
    Camera,
    Command,
    GizmoGrab,
    GizmoMove,
    GizmoRelease,
    NewValue,
    NodeClick,
    Picture,
    SceneClick,
    WidgetUpdate,
)
from taichi_mrf.viewer.transport.widget_values import Widget, is_same, value_to_set

SHORTEST_VECTOR = 1e-6
"""A direction or a quaternion below this norm points nowhere."""


class Gate:
    """Decides for one server; called in the server's event loop only, except :meth:`__init__`."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server

    def client_id(self, connection: ServerConnection) -> ClientId | None:
        """The number under which viser knows this connection."""
        connections = self._server._websock_server._live_connections
        return next((ClientId(id) for id, each in connections.items() if each is connection), None)

    def awaits_picture(self, client_id: ClientId) -> bool:
        """Whether a picture was asked of this client and has not arrived."""
        client = self._server.get_clients().get(client_id)
        return client is not None and bool(
            client._websock_connection._incoming_handlers.get(GetRenderResponseMessage)
        )

    def admit(self, client_id: ClientId, message: AnyClientMessage) -> AnyClientMessage | None:
        """The message as viser may have it; None if it must not have it."""
        match message:
            case Camera():
                return _tidy_camera(message)
            case WidgetUpdate():
                return self._tidy_update(client_id, message)
            case NodeClick():
                known = self._node(client_id, message.owner, message.name) is not None
                return _tidy_click(message) if known else None
            case SceneClick():
                return _tidy_click(message)
            case GizmoMove() | GizmoGrab() | GizmoRelease():
                return self._tidy_gizmo(client_id, message)
            case Picture():
                return message if self.awaits_picture(client_id) else None
            case Command():
                known = any(message.uuid in gui._command_handle_from_uuid for gui in self._guis(client_id))
                return message if known else None

    def _tidy_update(self, client_id: ClientId, message: WidgetUpdate) -> WidgetUpdate | None:
        """The update with a value that its widget can have. Where that is not what the client sent, the
        client is told what is in force."""
        widget = self._widget(client_id, message.uuid)
        if widget is None:
            return None
        sent = message.updates.value
        value = value_to_set(widget, sent)
        if value is not None and not _can_be_used(widget):
            value = None
        in_force = widget.value if value is None else value
        if not widget._impl.is_button and not is_same(sent, in_force):
            self._correct(client_id, message.uuid, in_force)
        return None if value is None else WidgetUpdate(message.uuid, NewValue(value))

    def _correct(self, client_id: ClientId, uuid: str, value: Any) -> None:
        """Tell one client alone which value a widget has."""
        state = self._server._websock_server._client_state_from_id.get(client_id)
        if state is not None:
            state.message_buffer.push(GuiUpdateMessage(uuid, {"value": value}))

    def _tidy_gizmo(
        self, client_id: ClientId, message: GizmoMove | GizmoGrab | GizmoRelease
    ) -> GizmoMove | GizmoGrab | GizmoRelease | None:
        """A gizmo that is shown may be used; one that is held may always be let go."""
        scene = self._scene(client_id, message.owner)
        if scene is None:
            return None
        if isinstance(message, GizmoRelease):
            held = (client_id, message.name) in scene._active_transform_drag_handles
            if held:
                return message
        gizmo = self._node(client_id, message.owner, message.name)
        if not isinstance(gizmo, viser.TransformControlsHandle) or not gizmo.visible:
            return None
        if isinstance(message, GizmoMove):
            wxyz = _unit(message.wxyz)
            return None if wxyz is None else msgspec.structs.replace(message, wxyz=wxyz)
        return message

    def _guis(self, client_id: ClientId) -> Iterator[viser.GuiApi]:
        """Where a client's widgets can be: on everybody's page, and on its own."""
        yield self._server.gui
        client = self._server.get_clients().get(client_id)
        if client is not None:
            yield client.gui

    def _widget(self, client_id: ClientId, uuid: str) -> Widget | None:
        found = (gui._gui_input_handle_from_uuid.get(uuid) for gui in self._guis(client_id))
        return next((widget for widget in found if widget is not None), None)

    def _scene(self, client_id: ClientId, owner: str) -> viser.SceneApi | None:
        """Everybody's scene (owner ""), or what only this client sees; nobody else's."""
        if owner == "":
            return self._server.scene
        client = self._server.get_clients().get(client_id)
        return client.scene if client is not None and client.scene._owner_id == owner else None

    def _node(self, client_id: ClientId, owner: str, name: str) -> viser.SceneNodeHandle | None:
        scene = self._scene(client_id, owner)
        return None if scene is None else scene._handle_from_node_name.get(name)


def _can_be_used(widget: Widget) -> bool:
    """Whether a person could use it: enabled, and shown together with all that it lies in."""
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
        if isinstance(container, viser.Gui3dContainerHandle):
            return True
        uuid = container._impl.parent_container_id
    return True


def _unit(vector: tuple[float, ...]) -> Any:
    """The vector or quaternion at length one; None if it has no direction."""
    norm = math.hypot(*vector)
    return None if norm < SHORTEST_VECTOR else tuple(component / norm for component in vector)


def _tidy_camera(message: Camera) -> Camera | None:
    """A canvas that is folded away has no pixels; viser divides by them."""
    wxyz, up_direction = _unit(message.wxyz), _unit(message.up_direction)
    if wxyz is None or up_direction is None or message.far <= message.near:
        return None
    return msgspec.structs.replace(
        message,
        wxyz=wxyz,
        up_direction=up_direction,
        image_height=max(message.image_height, 1),
        image_width=max(message.image_width, 1),
    )


def _tidy_click(message: NodeClick | SceneClick) -> NodeClick | SceneClick | None:
    ray_direction = _unit(message.ray_direction)
    return None if ray_direction is None else msgspec.structs.replace(message, ray_direction=ray_direction)
