"""What a browser may say to the viewer, word for word.

These are the messages that viser's stock client sends for what our page has: a camera, widgets, clicks,
gizmos, pictures that were asked for, and commands. A message of another kind, with another field, a wrong
type or a number that is not finite cannot be read, and so reaches nothing. The encoding is viser's own:
one msgpack map a message, its kind under "type" (viser.infra.Message.deserialize).
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
    """Base of all that a client may say; the tag is the name of viser's message."""


class Camera(ClientMessage, tag="ViewerCameraMessage"):
    """Where the viewer's eye is, T_world_camera in OpenCV's convention; ``fov`` is vertical, in radians."""

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
    """Something in the scene was clicked; ``screen_pos`` is in parts of the canvas."""

    name: Name
    instance_index: Annotated[int, Meta(ge=0, le=2**31)] | None
    ray_origin: Point
    ray_direction: Point
    screen_pos: ScreenPosition
    modifier: Modifier | None
    owner: Name = ""


class SceneClick(ClientMessage, tag="ScenePointerMessage"):
    """The scene was clicked somewhere."""

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
    """A picture of the page, as the server had asked for one."""

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
    """The bytes are not a message at all, so whoever sent them is no viewer's page."""


def decode(encoded: bytes) -> AnyClientMessage | None:
    """The message in these bytes; None if it is not one that a client may send.

    Raises :class:`Undecodable` where the bytes are no msgpack.
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
