"""How fast the device's memory is: the floor under every kernel that does little with each byte.

Measured by copying one array of float32 to another, both far larger than any cache, and counted as the bytes
read plus those written. What a CPU reads beside these because it is about to overwrite them is not counted.
"""

import time
from dataclasses import dataclass

from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, F32Array

TRIES = 5
STRIP = 64
"""Elements in a row for one iteration: on a CPU an iteration costs more than the copy of an element."""

CPU_BYTES, GPU_BYTES = 256 << 20, 1 << 30
"""Of each of the two arrays."""


@dataclass(frozen=True)
class Bandwidth:
    """Bytes read and written a second, and how that was found out."""

    bytes_per_second: float
    how: str


def copy_bandwidth(array_bytes: int = 0) -> Bandwidth:
    """The best of a few copies, of each of two kernels: an element, or a strip of them, for each iteration.

    ``array_bytes`` 0 means an amount that suits the backend.
    """
    array_bytes = array_bytes or (GPU_BYTES if runtime.active() == "cuda" else CPU_BYTES)
    n = array_bytes // 4 // STRIP * STRIP
    source, target = ti.ndarray(ti.f32, n), ti.ndarray(ti.f32, n)
    source.fill(1.0)
    best = {"elements": float("inf"), f"strips of {STRIP}": float("inf")}
    for name, copy in zip(best, (_copy_elements, _copy_strips), strict=True):
        for _ in range(TRIES + 1):  # the first is compiled, and its pages are new
            ti.sync()
            begin = time.perf_counter()
            copy(source, target, n)
            ti.sync()
            best[name] = min(best[name], time.perf_counter() - begin)
    way = min(best, key=lambda name: best[name])
    size = f"{8 * n / 1e6:.0f} MB"
    how = f"the fastest of {TRIES} copies by {way}, {size} read and written"
    runtime.settle()  # before the arrays are dropped
    return Bandwidth(8 * n / best[way], how)


@ti.kernel
def _copy_elements(source: F32Array, target: F32Array, n: I32):
    for i in range(n):
        target[i] = source[i]


@ti.kernel
def _copy_strips(source: F32Array, target: F32Array, n: I32):
    for strip in range(n // STRIP):
        for i in range(STRIP):
            target[strip * STRIP + i] = source[strip * STRIP + i]
