"""Places where a parameter can be set: all in Python, by far not all in files, and by flags those that change
from run to run."""

import dataclasses
from typing import Any, TypeVar, cast

T = TypeVar("T")

IN_FILES, IN_PYTHON = {"flag": False}, {"flag": False, "file": False}
"""The metadata of such fields."""


def in_files(default: T) -> T:
    """A field that has no flag: a file sets it (--config)."""
    return cast(T, dataclasses.field(default=default, metadata=IN_FILES))


def in_python(default: T) -> T:
    """A field that only Python sets. Map files hold it too."""
    return cast(T, dataclasses.field(default=default, metadata=IN_PYTHON))


def has_flag(field: "dataclasses.Field[Any]") -> bool:
    """True if a command has a flag for a field, or flags for its fields."""
    return bool(field.metadata.get("flag", True))


def is_in_files(field: "dataclasses.Field[Any]") -> bool:
    """True if a file of parameters may set a field."""
    return bool(field.metadata.get("file", True))
