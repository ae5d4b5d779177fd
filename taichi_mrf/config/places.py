"""Where a parameter can be set: in Python all, in a file what users of the program change, and by flags what
they change from run to run.
"""

import dataclasses
from typing import Any, TypeVar, cast

T = TypeVar("T")

_PLACES = "places"
IN_FILES: dict[str, Any] = {_PLACES: ("file",)}
"""Metadata of a field that has no flag: a file sets it (--config)."""

IN_PYTHON: dict[str, Any] = {_PLACES: ()}
"""Metadata of a field that only Python sets. Map files hold it too."""


def in_files(default: T) -> T:
    """A field that has no flag."""
    return cast(T, dataclasses.field(default=default, metadata=IN_FILES))


def in_python(default: T) -> T:
    """A field that only Python sets."""
    return cast(T, dataclasses.field(default=default, metadata=IN_PYTHON))


def has_flag(field: "dataclasses.Field[Any]") -> bool:
    """Whether a command has a flag for a field, or flags for its fields."""
    return _PLACES not in field.metadata


def is_in_files(field: "dataclasses.Field[Any]") -> bool:
    """Whether a file of parameters may set a field."""
    return "file" in field.metadata.get(_PLACES, ("file",))
