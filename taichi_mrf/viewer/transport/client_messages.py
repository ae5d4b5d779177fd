"""The messages that a browser may send to the viewer, read into viser's own classes.

viser's stock client sends these for the parts of our pages: a camera, widgets, clicks, gizmos, pictures that
were asked for, and commands. A message of another kind, with another field, a wrong type or a number that is
not finite is refused. The encoding is viser's: one msgpack map per message, its kind under "type"
(viser.infra.Message.deserialize).
"""

from dataclasses import fields
from typing import Any

import msgspec
from viser import _messages as theirs

_FIELDS: dict[type[theirs.Message], tuple[str, ...]] = {
    kind: tuple(field.name for field in fields(kind) if field.name != "excluded_self_client")
    for kind in (
        theirs.CommandTriggerMessage,
        theirs.GetRenderResponseMessage,
        theirs.GuiUpdateMessage,
        theirs.SceneNodeClickMessage,
        theirs.ScenePointerMessage,
        theirs.TransformControlsDragEndMessage,
        theirs.TransformControlsDragStartMessage,
        theirs.TransformControlsUpdateMessage,
        theirs.ViewerCameraMessage,
    )
}
"""The fields of each kind that a client may set."""

_KINDS: dict[Any, type[theirs.Message]] = {kind.__name__: kind for kind in _FIELDS}

LARGEST_COORDINATE = 1e9
"""Metres; far beyond any map, and its square is still a finite float32."""

DEEPEST = 6
"""Levels of lists and dictionaries within each other; the page's own messages have three."""

LONGEST_NAME = 1000
"""Characters of the name of a node or widget."""


class Undecodable(Exception):  # noqa: N818 - a finding about bytes, not a failure of ours
    """The bytes are no message, so the client is not a viewer's page."""


def decode(encoded: bytes) -> theirs.Message | None:
    """The message in these bytes; None if clients may not send it.

    Raises :class:`Undecodable` if the bytes are no msgpack.
    """
    try:
        said = msgspec.msgpack.decode(encoded)
    except msgspec.ValidationError:
        return None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Undecodable(str(error)) from error
    name = said.pop("type", None) if isinstance(said, dict) else None
    kind = _KINDS.get(name) if isinstance(name, str) else None
    if kind is None or not said.keys() <= set(_FIELDS[kind]):
        return None
    plain = [value for field, value in said.items() if field != "updates"]
    if not _is_shallow(said, DEEPEST) or not _is_sane(plain):
        return None
    try:
        return msgspec.convert(said, kind)
    except msgspec.ValidationError:
        return None


def encode(message: theirs.Message) -> bytes:
    """The message as viser reads it."""
    kind = type(message)
    return msgspec.msgpack.encode(
        {"type": kind.__name__, **{name: getattr(message, name) for name in _FIELDS[kind]}}
    )


def _is_shallow(value: Any, levels: int) -> bool:
    """True if lists and dictionaries lie within each other on so many levels at most."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels >= 0 and all(_is_shallow(each, levels - 1) for each in inside)


def _is_sane(value: Any) -> bool:
    """True if numbers are finite and lie within a scene, and names have the length of one."""
    match value:
        case list():
            return all(map(_is_sane, value))
        case str():
            return len(value) <= LONGEST_NAME
        case int() | float():
            return abs(value) <= LARGEST_COORDINATE
    return True
