"""Modules that are loaded when they are first used, so that a program pays only for what it does."""

import importlib
from typing import Any


class Later:
    """Stands for a module. A type checker sees the module itself, imported under ``TYPE_CHECKING``."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._name), name)


def later(package: str, *names: str) -> tuple[Any, ...]:
    """Some modules of a package, each loaded when it is first used."""
    return tuple(Later(f"{package}.{name}") for name in names)
