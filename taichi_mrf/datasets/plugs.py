"""Formats that other packages bring, and those of this one that few have.

A plug is an entry point of the group GROUP that names a Format (base.py). It is asked before the formats of
entries.py, so that it can read what one of those would take. One that cannot be used breaks no other.
"""

import warnings
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from taichi_mrf.datasets.base import Dataset, Format
from taichi_mrf.errors import DatasetError, TaichiMRFError, said

GROUP = "taichi_mrf.formats"

OWN = {
    name: f"taichi_mrf.datasets.rare:{name.upper()}"
    for name in ("several_sensors", "stray_scanner", "record3d", "las", "ouster", "rtabmap")
}
"""This package's, as pyproject.toml declares them, for a checkout that is not installed."""


@cache
def plugs() -> tuple[tuple[Format, ...], tuple[str, ...]]:
    """All plugs, this package's first, and a line about each that cannot be used."""
    own = [EntryPoint(name, value, GROUP) for name, value in OWN.items()]
    found = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    others = [point for point in found if OWN.get(point.name) != point.value]
    formats, problems = [plug.load() for plug in own], []
    for point in others:
        try:
            formats.append(_guarded(point.name, point.load()))
        except Exception as error:  # whatever a module of others raises
            problems.append(_problem(point.name, error))
    return tuple(formats), tuple(problems)


def _guarded(plug: str, found: Any) -> Format:
    """A format of others, whose errors name its plug."""
    if not isinstance(found, Format):
        raise TypeError(f"it names {found!r}, which is no Format")

    def recognises(path: Path) -> bool:
        try:
            return bool(found.recognises(path))
        except Exception as error:
            warnings.warn(_problem(plug, error), stacklevel=2)
            return False

    def open_source(path: Path, *options: Any) -> Dataset:
        try:
            return found.open(path, *options)
        except (TaichiMRFError, OSError):
            raise
        except Exception as error:
            raise DatasetError(f"{path}: {_problem(plug, error)}") from error

    return replace(found, recognises=recognises, open=open_source)


def _problem(plug: str, error: Exception) -> str:
    return f"the plug {plug!r} ({GROUP}) cannot be used: {type(error).__name__}: {said(error)}"
