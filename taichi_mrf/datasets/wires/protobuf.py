"""Messages in protobuf's encoding as dictionaries, by the descriptors that their channel brings.

A message is a row of fields: a key, which is the number of the field and how its value is written, and the
value (https://protobuf.dev/programming-guides/encoding). Descriptors, a FileDescriptorSet, are messages, too.
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

_VARINT, _EIGHT_BYTES, _LENGTH, _FOUR_BYTES = 0, 1, 2, 5
_FIXED = {1: "<d", 2: "<f", 6: "<Q", 7: "<I", 15: "<i", 16: "<q"}
"""Kinds of fields that are written in four or eight bytes."""

_SIGNED, _BOOL, _TEXT, _MESSAGE, _BYTES = (3, 5), 8, 9, 11, 12
_REPEATED = 3


class Field(NamedTuple):
    """A field: its name, its kind by descriptor.proto's numbers, whether it is a list, and the type of the
    message that it is."""

    name: str
    kind: int
    repeated: bool
    type: str


Types = dict[str, dict[int, Field]]
"""The fields of each type of message, by their numbers."""


def types_of(descriptors: bytes) -> Types:
    """The types in a FileDescriptorSet, such as foxglove.RawImage. Raises ValueError if it is none."""
    found: Types = {}
    for number, file in _parts(descriptors):
        if number == 1:
            parts = list(_parts(file))
            package = next((bytes(each).decode() for n, each in parts if n == 2), "")
            for n, message in parts:
                if n == 4:
                    _add(found, package, message)
    return found


def _add(found: Types, outer: str, descriptor: Any) -> None:
    """Add a DescriptorProto, and those in it."""
    parts = list(_parts(descriptor))
    name = next(bytes(each).decode() for n, each in parts if n == 1)
    name = f"{outer}.{name}" if outer else name
    found[name] = dict(_field(each) for n, each in parts if n == 2)
    for n, each in parts:
        if n == 3:
            _add(found, name, each)


def _field(descriptor: Any) -> tuple[int, Field]:
    said = dict(_parts(descriptor))
    type_name = bytes(said.get(6, b"")).decode().lstrip(".")
    return said[3], Field(bytes(said[1]).decode(), said[5], said.get(4) == _REPEATED, type_name)


def decode(data: bytes | memoryview, name: str, types: Mapping[str, Mapping[int, Field]]) -> dict[str, Any]:
    """The fields of a message of a type that were sent; others have their default. Raises ValueError or
    KeyError for damaged data."""
    found: dict[str, Any] = {}
    for number, value in _parts(data):
        field = types[name].get(number)
        if field is None:
            continue
        if field.repeated:
            packed = isinstance(value, memoryview) and field.kind not in (_TEXT, _MESSAGE, _BYTES)
            values = _unpacked(field, value) if packed else [_value(field, value, types)]
            found.setdefault(field.name, []).extend(values)
        else:
            found[field.name] = _value(field, value, types)
    return found


def _value(field: Field, value: Any, types: Mapping[str, Mapping[int, Field]]) -> Any:
    if field.kind == _MESSAGE:
        return decode(value, field.type, types)
    if field.kind in _FIXED:
        return struct.unpack(_FIXED[field.kind], value)[0]
    if field.kind == _TEXT:
        return bytes(value).decode()
    if field.kind == _BYTES:
        return bytes(value)
    if field.kind == _BOOL:
        return bool(value)
    return value - (1 << 64) if field.kind in _SIGNED and value >> 63 else value


def _unpacked(field: Field, values: memoryview) -> list[Any]:
    """The numbers of a list."""
    if field.kind in _FIXED:
        return [each for (each,) in struct.iter_unpack(_FIXED[field.kind], values)]
    found, at = [], 0
    while at < len(values):
        value, at = _varint(values, at)
        found.append(_value(field, value, {}))
    return found


def _parts(data: bytes | memoryview) -> Iterator[tuple[int, Any]]:
    """The fields of a message: their numbers, and a whole number or the bytes of each."""
    data, at = memoryview(data), 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        if kind == _LENGTH:
            size, at = _varint(data, at)
        elif kind in (_EIGHT_BYTES, _FOUR_BYTES):
            size = 8 if kind == _EIGHT_BYTES else 4
        else:
            raise ValueError(f"field {number} is written in an unknown way, {kind}")
        if at + size > len(data):
            raise ValueError(f"field {number} ends after the message does")
        yield number, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """A whole number in groups of 7 bits, and the place behind it."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            break
        value |= (data[at] & 0x7F) << shift
        at += 1
        if not data[at - 1] & 0x80:
            return value, at
    raise ValueError("a number does not end")
