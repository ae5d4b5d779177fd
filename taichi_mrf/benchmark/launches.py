"""Kernel launches, watched from outside: how often the host waits for the device, and how long each takes.

On a device with a memory of its own, the launch of a kernel that is handed a NumPy array waits until that has
been copied there and back; reading an array back is such a launch too. On a CPU no copy is needed.
"""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taichi_mrf.system import compiler, runtime
from taichi_mrf.system.compiler import ti


@dataclass
class Launches:
    """``number`` of launches, and those that the host has to ``wait`` for, because a NumPy array goes in or
    comes out; ``seconds`` of each launch by the kernel's name, if they are timed."""

    number: int = 0
    waits: int = 0
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


@contextmanager
def count_launches(timed: bool = False) -> Iterator[Launches]:
    """Watch all launches while the block runs. ``timed`` waits for each kernel, so as to time it."""
    launches = Launches()
    kernels = compiler.kernel_class()
    launch = kernels.launch_kernel
    apart = runtime.active() != "cpu"

    def watched(self: Any, *arguments: Any, **named: Any) -> Any:
        launches.number += 1
        launches.waits += apart and any(isinstance(argument, np.ndarray) for argument in arguments)
        if not timed:
            return launch(self, *arguments, **named)
        ti.sync()
        begin = time.perf_counter()
        result = launch(self, *arguments, **named)
        ti.sync()
        launches.seconds[self.func.__name__].append(time.perf_counter() - begin)
        return result

    kernels.launch_kernel = watched
    try:
        yield launches
    finally:
        kernels.launch_kernel = launch
