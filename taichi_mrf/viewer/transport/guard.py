"""The gate behind the websocket: which messages of a client reach viser, and in which form.

viser trusts its clients: any of them may write any property of any widget, upload files and open a public
tunnel. Here a message passes only if it is about something that exists, is shown and can be used, and its
values are ones that the widget could have sent.
"""

import math
from typing import Any

import msgspec
import viser
from viser.infra import ClientId
from websockets.asyncio.server import ServerConnection

from taichi_mrf.viewer.transport import viser_internals as internals
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
from taichi_mrf.viewer.transport.widget_values import is_out_of_range, is_same, value_to_set

SHORTEST_VECTOR = 1e-6
"""A direction or a quaternion with a smaller norm has no direction."""


class Gate:
    """Decides for one server; called in the server's event loop only, except :meth:`__init__`."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server

    def client_id(self, connection: ServerConnection) -> ClientId | None:
        """viser's number of this connection."""
        connections = internals.connections(self._server)
        return next((ClientId(id) for id, each in connections.items() if each is connection), None)

    def awaits_picture(self, client_id: ClientId) -> bool:
        """True if a picture was asked of this client and has not arrived."""
        return internals.awaits_picture(self._server, client_id)

    def may_be_unfinished(self, client_id: ClientId, message: AnyClientMessage) -> bool:
        """True if the message may be a number that is still being typed: one outside the range of its widget,
        as the 0 of 0.8 is, and any of a vector, each of whose values may move a keyframe."""
        if not isinstance(message, WidgetUpdate):
            return False
        widget = internals.input_widget(self._server, client_id, message.uuid)
        is_vector = isinstance(widget, viser.GuiVector2Handle | viser.GuiVector3Handle)
        return is_vector or (widget is not None and is_out_of_range(widget, message.updates.value))

    def admit(self, client_id: ClientId, message: AnyClientMessage) -> AnyClientMessage | None:
        """The message as viser may have it; None if viser must not have it."""
        match message:
            case Camera():
                return _tidy_camera(message)
            case WidgetUpdate():
                return self._tidy_update(client_id, message)
            case NodeClick():
                scene = internals.scene_of(self._server, client_id, message.owner)
                known = scene is not None and internals.node(scene, message.name) is not None
                return _tidy_click(message) if known else None
            case SceneClick():
                return _tidy_click(message)
            case GizmoMove() | GizmoGrab() | GizmoRelease():
                return self._tidy_gizmo(client_id, message)
            case Picture():
                return message if self.awaits_picture(client_id) else None
            case Command():
                return message if internals.has_command(self._server, client_id, message.uuid) else None

    def _tidy_update(self, client_id: ClientId, message: WidgetUpdate) -> WidgetUpdate | None:
        """The update with a value that its widget can have. If that is not what the client sent, the client
        is told which value is in force."""
        widget = internals.input_widget(self._server, client_id, message.uuid)
        if widget is None:
            return None
        sent = message.updates.value
        value: Any = value_to_set(widget, sent)
        if value is not None and not internals.can_be_used(widget):
            value = None
        in_force = widget.value if value is None else value
        if not internals.is_button(widget) and not is_same(sent, in_force):
            internals.tell_value(self._server, client_id, message.uuid, in_force)
        return None if value is None else WidgetUpdate(message.uuid, NewValue(value))

    def _tidy_gizmo(
        self, client_id: ClientId, message: GizmoMove | GizmoGrab | GizmoRelease
    ) -> GizmoMove | GizmoGrab | GizmoRelease | None:
        """A gizmo that is shown may be used; one that is held may always be let go."""
        scene = internals.scene_of(self._server, client_id, message.owner)
        if scene is None:
            return None
        if isinstance(message, GizmoRelease) and internals.holds_gizmo(scene, client_id, message.name):
            return message
        gizmo = internals.node(scene, message.name)
        if not isinstance(gizmo, viser.TransformControlsHandle) or not gizmo.visible:
            return None
        if isinstance(message, GizmoMove):
            wxyz = _unit(message.wxyz)
            return None if wxyz is None else msgspec.structs.replace(message, wxyz=wxyz)
        return message


def _unit(vector: tuple[float, ...]) -> Any:
    """The vector or quaternion at length one; None if it has no direction."""
    norm = math.hypot(*vector)
    return None if norm < SHORTEST_VECTOR else tuple(component / norm for component in vector)


def _tidy_camera(message: Camera) -> Camera | None:
    """A canvas that is folded away has no pixels; viser divides by their number."""
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
