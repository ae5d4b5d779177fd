"""The messages that a browser may send to the viewer.

viser's stock client sends these for the parts of our pages: a camera, widgets, clicks, gizmos, pictures that
were asked for, and commands. A message of another kind, with another field, a wrong type or a number that is
not finite is refused. The encoding is viser's: one msgpack map per message, its kind under "type"
(viser.infra.Message.deserialize).
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

LARGEST_COORDINATE = 1e9
"""Metres; far beyond any map, and its square is still a finite float32."""

Coordinate = Annotated[float, Meta(ge=-LARGEST_COORDINATE, le=LARGEST_COORDINATE)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Component = Annotated[float, Meta(ge=-1e3, le=1e3)]
Quaternion = tuple[Component, Component, Component, Component]
Distance = Annotated[float, Meta(gt=0.0, le=LARGEST_COORDINATE)]
FieldOfView = Annotated[float, Meta(gt=0.0, lt=3.14159)]
Pixels = Annotated[int, Meta(ge=0, le=65536)]
ScreenPosition = tuple[Component, Component]
Name = Annotated[str, Meta(max_length=1000)]
Modifier = Literal[
    "cmd/ctrl", "alt", "shift", "cmd/ctrl+alt", "cmd/ctrl+shift", "alt+shift", "cmd/ctrl+alt+shift"
]
WidgetValue = bool | int | float | str | Annotated[list[int | float], Meta(max_length=64)]


class ClientMessage(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """Base of all messages of clients; the tag is the name of viser's message."""


class Camera(ClientMessage, tag="ViewerCameraMessage"):
    """The viewpoint: T_world_camera in OpenCV's convention; ``fov`` is vertical, in radians."""

    wxyz: Quaternion
    position: Point
    fov: FieldOfView
    near: Distance
    far: Distance
    image_height: Pixels
    image_width: Pixels
    look_at: Point
    up_direction: Point


class NewValue(msgspec.Struct, forbid_unknown_fields=True):
    """The only property of a widget that a client may write."""

    value: WidgetValue


class WidgetUpdate(ClientMessage, tag="GuiUpdateMessage"):
    """A widget was used."""

    uuid: Name
    updates: NewValue


class NodeClick(ClientMessage, tag="SceneNodeClickMessage"):
    """A node was clicked; ``screen_pos`` is relative to the canvas, 0 to 1."""

    name: Name
    instance_index: Annotated[int, Meta(ge=0, le=2**31)] | None
    ray_origin: Point
    ray_direction: Point
    screen_pos: ScreenPosition
    modifier: Modifier | None
    owner: Name = ""


class SceneClick(ClientMessage, tag="ScenePointerMessage"):
    """The scene was clicked, at any place."""

    event_type: Literal["click"]
    ray_origin: Point
    ray_direction: Point
    screen_pos: tuple[ScreenPosition]
    modifier: Modifier | None


class GizmoMove(ClientMessage, tag="TransformControlsUpdateMessage"):
    """A gizmo is being dragged: its pose in its parent's frame."""

    name: Name
    wxyz: Quaternion
    position: Point
    owner: Name = ""


class GizmoGrab(ClientMessage, tag="TransformControlsDragStartMessage"):
    """A drag begins."""

    name: Name
    owner: Name = ""


class GizmoRelease(ClientMessage, tag="TransformControlsDragEndMessage"):
    """A drag ends."""

    name: Name
    owner: Name = ""


class Picture(ClientMessage, tag="GetRenderResponseMessage"):
    """A picture of the page that the server has asked for."""

    payload: bytes
    render_uuid: Name


class Command(ClientMessage, tag="CommandTriggerMessage"):
    """A command was chosen from the palette or by its key."""

    uuid: Name


AnyClientMessage = (
    Camera | WidgetUpdate | NodeClick | SceneClick | GizmoMove | GizmoGrab | GizmoRelease | Picture | Command
)

_DECODER = msgspec.msgpack.Decoder(AnyClientMessage)
_ENCODER = msgspec.msgpack.Encoder()


class Undecodable(Exception):  # noqa: N818 - a finding about bytes, not a failure of ours
    """The bytes are no message, so the client is not a viewer's page."""


def decode(encoded: bytes) -> AnyClientMessage | None:
    """The message in these bytes; None if clients may not send it.

    Raises :class:`Undecodable` if the bytes are no msgpack.
    """
    try:
        return _DECODER.decode(encoded)
    except msgspec.ValidationError:
        return None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Undecodable(str(error)) from error


def encode(message: ClientMessage) -> bytes:
    """The message as viser reads it."""
    return _ENCODER.encode(message)
