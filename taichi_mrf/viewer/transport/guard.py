"""The gate behind the websocket: which messages of a client reach viser, and in which form.

viser trusts its clients: any of them may write any property of any widget, upload files and open a public
tunnel. Here a message passes only if it is about something that exists, is shown and can be used, and its
values are ones that the widget could have sent. The value that a widget takes is of its own type, in its
range, on its grid.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import viser
from viser import _messages as theirs
from viser.infra import ClientId
from websockets.asyncio.server import ServerConnection

from taichi_mrf.viewer.transport import viser_internals as internals
from taichi_mrf.viewer.transport.viser_internals import Widget

SHORTEST_VECTOR = 1e-6
"""A direction or a quaternion with a smaller norm has no direction."""

LONGEST_TEXT = 200
"""Characters of a text field; no widget of the pages needs more."""

LARGEST_NUMBER = 2**53
"""Beyond this a browser's numbers cannot hold every integer, and msgpack ends at 2^64."""

MOST_PIXELS = 65536
"""Along each side of a canvas."""

Bounds = tuple[float | None, float | None]


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

    def may_be_unfinished(self, client_id: ClientId, message: theirs.GuiUpdateMessage) -> bool:
        """True if the message may be a number that is still being typed: one outside the range of its widget,
        as the 0 of 0.8 is, and any of a vector, each of whose values may move a keyframe."""
        widget = internals.input_widget(self._server, client_id, message.uuid)
        is_vector = isinstance(widget, viser.GuiVector2Handle | viser.GuiVector3Handle)
        return is_vector or (widget is not None and is_out_of_range(widget, message.updates.get("value")))

    def admit(self, client_id: ClientId, message: theirs.Message) -> theirs.Message | None:
        """The message as viser may have it; None if viser must not have it."""
        match message:
            case theirs.ViewerCameraMessage():
                return _tidy_camera(message)
            case theirs.GuiUpdateMessage():
                return self._tidy_update(client_id, message)
            case theirs.SceneNodeClickMessage():
                scene = internals.scene_of(self._server, client_id, message.owner)
                known = scene is not None and internals.node(scene, message.name) is not None
                return _tidy_click(message) if known and (message.instance_index or 0) >= 0 else None
            case theirs.ScenePointerMessage():
                if message.event_type == "click":
                    return _tidy_click(message) if len(message.screen_pos) == 1 else None
                corners = [share for corner in message.screen_pos for share in corner]
                is_rectangle = len(message.screen_pos) == 2 and 0 <= min(corners) <= max(corners) <= 1
                return replace(message, ray_origin=None, ray_direction=None) if is_rectangle else None
            case theirs.GetRenderResponseMessage():
                return message if self.awaits_picture(client_id) else None
            case theirs.CommandTriggerMessage():
                return message if internals.has_command(self._server, client_id, message.uuid) else None
        return self._tidy_gizmo(client_id, message)

    def _tidy_update(
        self, client_id: ClientId, message: theirs.GuiUpdateMessage
    ) -> theirs.GuiUpdateMessage | None:
        """The update with a value that its widget can have. If that is not what the client sent, the client
        is told which value is in force. A client may write no other property of a widget."""
        widget = internals.input_widget(self._server, client_id, message.uuid)
        if widget is None or message.updates.keys() != {"value"}:
            return None
        sent = message.updates["value"]
        value: Any = value_to_set(widget, sent)
        if value is not None and not internals.can_be_used(widget):
            value = None
        in_force = widget.value if value is None else value
        if not internals.is_button(widget) and not is_same(sent, in_force):
            internals.tell_value(self._server, client_id, message.uuid, in_force)
        return None if value is None else theirs.GuiUpdateMessage(message.uuid, {"value": value})

    def _tidy_gizmo(self, client_id: ClientId, message: Any) -> theirs.Message | None:
        """A gizmo that is shown may be used; one that is held may always be let go."""
        scene = internals.scene_of(self._server, client_id, message.owner)
        if scene is None:
            return None
        is_release = isinstance(message, theirs.TransformControlsDragEndMessage)
        if is_release and internals.holds_gizmo(scene, client_id, message.name):
            return message
        gizmo = internals.node(scene, message.name)
        if not isinstance(gizmo, viser.TransformControlsHandle) or not gizmo.visible:
            return None
        if isinstance(message, theirs.TransformControlsUpdateMessage):
            wxyz = _unit(message.wxyz)
            return None if wxyz is None else replace(message, wxyz=wxyz)
        return message


def _unit(vector: tuple[float, ...] | None) -> Any:
    """The vector or quaternion at length one; None if it has no direction."""
    norm = math.hypot(*(vector or ()))
    return None if vector is None or norm < SHORTEST_VECTOR else tuple(part / norm for part in vector)


def _tidy_camera(message: theirs.ViewerCameraMessage) -> theirs.ViewerCameraMessage | None:
    """A canvas that is folded away has no pixels; viser divides by their number."""
    wxyz, up_direction = _unit(message.wxyz), _unit(message.up_direction)
    sides = message.image_height, message.image_width
    is_possible = 0 < message.fov < math.pi and 0 < message.near < message.far
    is_possible &= 0 <= min(sides) <= max(sides) <= MOST_PIXELS
    if wxyz is None or up_direction is None or not is_possible:
        return None
    height, width = (max(side, 1) for side in sides)
    return replace(message, wxyz=wxyz, up_direction=up_direction, image_height=height, image_width=width)


def _tidy_click(message: theirs.SceneNodeClickMessage | theirs.ScenePointerMessage) -> theirs.Message | None:
    ray_direction = _unit(message.ray_direction)
    if ray_direction is None or message.ray_origin is None:
        return None
    return replace(message, ray_direction=ray_direction)


def value_to_set(widget: Widget, sent: Any) -> Any | None:
    """The value that ``widget`` takes when ``sent`` arrives; None if it must not change.

    Numbers are clamped and rounded, text is cut; a value of the wrong type, a choice that is not offered
    or the wrong count of numbers is refused.
    """
    match widget:
        case viser.GuiCheckboxHandle():
            return sent if isinstance(sent, bool) else None
        case viser.GuiButtonHandle():
            return True if sent is True else None
        case viser.GuiButtonGroupHandle() | viser.GuiDropdownHandle():
            return sent if isinstance(sent, str) and sent in widget.options else None
        case viser.GuiTextHandle():
            return sent[:LONGEST_TEXT] if isinstance(sent, str) else None
        case viser.GuiSliderHandle():
            return _on_grid(sent, widget.min, widget, widget.value) if _is_number(sent) else None
        case viser.GuiNumberHandle():
            return _field_value(widget, sent, (widget.min, widget.max), widget.value)
        case viser.GuiMultiSliderHandle():
            return _multi_slider_value(widget, sent)
        case viser.GuiRgbHandle() | viser.GuiRgbaHandle():
            channels = _numbers(sent, len(widget.value))
            return channels and tuple(int(_clamp(round(channel), (0, 255))) for channel in channels)
        case viser.GuiVector2Handle() | viser.GuiVector3Handle():
            return _vector_value(widget, sent)
    return None


def is_out_of_range(widget: Widget, sent: Any) -> bool:
    """True if ``sent`` is a number that the slider or field cannot show."""
    if not isinstance(widget, viser.GuiSliderHandle | viser.GuiNumberHandle) or not _is_number(sent):
        return False
    return _clamp(sent, (widget.min, widget.max)) != sent


def is_same(sent: Any, taken: Any) -> bool:
    """True if a client that shows ``sent`` shows what is in force, but for the last bits of a float."""
    if isinstance(sent, list) and isinstance(taken, tuple):
        return len(sent) == len(taken) and all(map(is_same, sent, taken))
    if _is_number(sent) and _is_number(taken):
        return math.isclose(sent, taken, rel_tol=1e-9, abs_tol=1e-9)
    return bool(sent == taken)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _numbers(sent: Any, count: int) -> Sequence[float] | None:
    """``sent`` if it is a list of ``count`` finite numbers."""
    if isinstance(sent, list) and len(sent) == count and all(map(_is_number, sent)):
        return sent
    return None


def _clamp(value: float, bounds: Bounds) -> float:
    lower, upper = bounds
    lower = -LARGEST_NUMBER if lower is None else lower
    upper = LARGEST_NUMBER if upper is None else upper
    return min(max(value, lower), upper)


def _on_grid(value: float, origin: float, widget: Any, current: float) -> float:
    """``value`` clamped to the slider's range and rounded to ``origin`` + k step, or one of its ends.

    The ends count although they may lie off the grid, as they do for the client.
    """
    value = _clamp(value, (widget.min, widget.max))
    if value not in (widget.min, widget.max):
        stepped = origin + round((value - origin) / widget.step) * widget.step
        value = _clamp(round(stepped, widget.precision), (widget.min, widget.max))
    return type(current)(value)


def _multi_slider_value(widget: viser.GuiMultiSliderHandle, sent: Any) -> tuple[float, ...] | None:
    """Handles in ascending order; the client counts the steps of this widget from zero."""
    numbers = _numbers(sent, len(widget.value))
    if numbers is None:
        return None
    handles = [
        current if is_same(number, current) else _on_grid(number, 0.0, widget, current)
        for number, current in zip(numbers, widget.value, strict=True)
    ]
    if widget.fixed_endpoints and handles:
        handles[0], handles[-1] = widget.value[0], widget.value[-1]
    smallest_gap = (widget.min_range or 0.0) - 1e-9
    if any(upper - lower < smallest_gap for lower, upper in pairwise(handles)):
        return None
    return tuple(handles)


def _field_value(widget: Any, sent: Any, bounds: Bounds, current: float) -> float | None:
    """A typed number; a field's step is what its arrows add, its grid are the decimals it shows."""
    if not _is_number(sent):
        return None
    return type(current)(_clamp(round(sent, widget.precision), bounds))


def _vector_value(
    widget: viser.GuiVector2Handle | viser.GuiVector3Handle, sent: Any
) -> tuple[float, ...] | None:
    numbers = _numbers(sent, len(widget.value))
    if numbers is None:
        return None
    unbounded = (None,) * len(numbers)
    values = (
        _field_value(widget, *each)
        for each in zip(
            numbers,
            zip(widget.min or unbounded, widget.max or unbounded, strict=True),
            widget.value,
            strict=True,
        )
    )
    return tuple(value for value in values if value is not None)
