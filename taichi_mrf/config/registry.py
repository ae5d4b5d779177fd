"""The entries of all mapping methods, loaded from the plugs.

The configuration's sections, the command line's choices, the tuning page, map files and the questions that
live runs ask of a map all follow from these entries.
"""

import importlib
from typing import TYPE_CHECKING, Literal

from taichi_mrf.config.method import Method
from taichi_mrf.config.plugs import PLUGS


def _loaded() -> dict[str, Method]:
    entries: list[Method] = [importlib.import_module(plug).METHOD for plug in PLUGS]
    return {method.name: method for method in entries}


METHODS = _loaded()
"""All methods by name, in the order of PLUGS."""


def methods_with(capability: str) -> str:
    """The names of the methods that have a capability (a field of Method), as an error names them."""
    return " or ".join(method.name for method in METHODS.values() if getattr(method, capability))


def octomap_method() -> Method:
    """The method whose maps hold what OctoMap's do."""
    return next(method for method in METHODS.values() if method.is_octomap)


if TYPE_CHECKING:
    MethodName = str
else:
    MethodName = Literal[tuple(METHODS)]
