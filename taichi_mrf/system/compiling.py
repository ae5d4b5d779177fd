"""The time for which a process waits for the compiler of kernels, and who is told before it waits again.

A kernel is compiled when it is first launched, unless its machine code is in the compiler's cache. Meanwhile
the compiler holds Python's lock, so nothing can be said while it works, only before.
"""

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from taichi_mrf.system import compiler

WORTH_A_WORD_S = 1.0
"""Nothing is said of waits that are shorter than this since the last step of the work."""


@dataclass
class Compiling:
    """The kernels of this process so far: their number, and by their names the seconds that they took, to
    compile or to load."""

    seconds: dict[str, float] = field(default_factory=dict)
    number: int = 0

    @property
    def total_s(self) -> float:
        """Seconds of all kernels."""
        return sum(self.seconds.values())


so_far = Compiling()
all_passes: dict[str, Collection[str]] = {}
"""Settings of the compiler that are off, and the kernels, by name, that are compiled with them on."""
_listeners: list[Callable[[], None]] = []
_unlaunched: set[Any] = set()


class Waiting:
    """Time spent compiling since the last step, reported once it is worth a word."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self.step()

    def step(self) -> None:
        """A step of the work is done, and what is said of it has taken the place of these words."""
        self._since_s = so_far.total_s

    def look(self) -> None:
        """Called before each first launch of a kernel."""
        if so_far.total_s - self._since_s > WORTH_A_WORD_S:
            self._tell(f"compiling kernels, once on this machine: {so_far.number} so far")


@contextmanager
def told(waiting: Waiting) -> Iterator[None]:
    """Tell one who waits while the block runs."""
    _listeners.append(waiting.look)
    try:
        yield
    finally:
        _listeners.remove(waiting.look)


def watch() -> None:
    """Watch the launches of this process from now on."""
    kernels = compiler.kernel_class()
    materialize, launch = kernels.materialize, kernels.launch_kernel

    def materialize_watched(self: Any, *arguments: Any, **named: Any) -> Any:
        known = len(compiler.kernels_of(self))
        result = materialize(self, *arguments, **named)
        if len(compiler.kernels_of(self)) > known:
            _unlaunched.add(self)
        return result

    def launch_watched(self: Any, *arguments: Any, **named: Any) -> Any:
        if self not in _unlaunched:
            return launch(self, *arguments, **named)
        _unlaunched.discard(self)
        for tell in _listeners:
            tell()
        so_far.number += 1
        with _timed(self.func.__name__):
            return launch(self, *arguments, **named)

    kernels.materialize, kernels.launch_kernel = materialize_watched, launch_watched


@contextmanager
def _timed(name: str) -> Iterator[None]:
    """Time the compiler, apart from the kernel that runs after it."""
    program = type(compiler.program())
    compile_kernel = program.compile_kernel

    def compile_timed(program: Any, config: Any, *arguments: Any) -> Any:
        begin = time.thread_time()
        for setting, kernels in all_passes.items():
            setattr(config, setting, name in kernels)
        try:
            return compile_kernel(program, config, *arguments)
        finally:
            for setting in all_passes:
                setattr(config, setting, False)
            so_far.seconds[name] = so_far.seconds.get(name, 0.0) + time.thread_time() - begin

    program.compile_kernel = compile_timed
    try:
        yield
    finally:
        program.compile_kernel = compile_kernel
