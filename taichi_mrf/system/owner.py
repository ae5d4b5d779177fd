"""Taichi belongs to the thread that starts it. Maps check that they are called in this thread.

Taichi keeps one runtime for a process and does not lock it: threads that use it side by side lose data or end
in its internal errors, a forked child waits for threads that it does not have, and a second ``ti.init`` frees
the memory that the maps use. Each of these is a BackendError here, before a kernel is launched.
"""

import functools
import inspect
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from taichi_mrf.errors import BackendError
from taichi_mrf.system import compiler


@dataclass(frozen=True)
class _Owner:
    thread: int
    thread_name: str
    implementation: Any
    """Taichi's module that keeps the runtime, None before it is loaded."""
    attribute: str
    """Its attribute that is the runtime, which ``ti.init`` and ``ti.reset`` replace."""
    runtime: Any


_owner: _Owner | None = None
_forked = False
"""True in a process that was forked from one in which Taichi runs."""


def claim() -> None:
    """Make the calling thread the owner of Taichi's present runtime."""
    global _owner
    implementation, attribute = compiler.runtime_place()
    runtime = getattr(implementation, attribute, None)
    thread = threading.current_thread()
    _owner = _Owner(threading.get_ident(), thread.name, implementation, attribute, runtime)


def check_owner() -> None:
    """Raise BackendError unless the caller is the owner and Taichi still runs as it did when claimed."""
    owner = _owner
    if owner is None:
        return
    if _forked:
        raise BackendError(
            f"this process was forked from one in which {compiler.title()} runs, and cannot use it: start a "
            "new process instead (multiprocessing's method 'spawn')"
        )
    if threading.get_ident() != owner.thread:
        raise BackendError(
            f"maps can only be used in the thread that started {compiler.title()} ('{owner.thread_name}'), "
            f"not in '{threading.current_thread().name}'"
        )
    if owner.implementation is not None and (
        getattr(owner.implementation, owner.attribute) is not owner.runtime
    ):
        raise BackendError(
            f"{compiler.title()} was started again (ti.init or ti.reset) after taichi_mrf, which frees the "
            "memory of all maps: call ti.init before the first map, or use taichi_mrf.init instead"
        )


class Owned:
    """Base of classes whose public methods check the owner first. Properties and class methods do not."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for name, member in list(vars(cls).items()):
            if inspect.isfunction(member) and not name.startswith("_"):
                setattr(cls, name, _checked(member))


class OwnedAttribute:
    """An attribute that checks the owner when it is read."""

    def __set_name__(self, cls: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, cls: type | None = None) -> Any:
        if instance is None:
            raise AttributeError(self._name)  # which tells dataclasses that there is no default
        check_owner()
        return instance.__dict__[self._name]

    def __set__(self, instance: Any, value: Any) -> None:
        instance.__dict__[self._name] = value


def owned_attribute() -> Any:
    """An OwnedAttribute that a type checker accepts for an attribute of any type."""
    return OwnedAttribute()


def _checked(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def call(*arguments: Any, **keywords: Any) -> Any:
        check_owner()
        return method(*arguments, **keywords)

    return call


def _note_fork() -> None:
    global _forked
    _forked = _owner is not None


if hasattr(os, "register_at_fork"):  # cheaper than asking for the process's number in each call
    os.register_at_fork(after_in_child=_note_fork)
