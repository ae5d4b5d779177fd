"""Arrays of vectors that are freed when Python collects them, as Taichi's arrays of scalars are."""

import weakref
from typing import Any

import taichi as ti
from taichi.lang import impl

from taichi_mrf.kernels.types import Vec4


def vec4_array(length: int) -> "ti.Ndarray":
    """An array of 4-vectors of float32, all zero.

    Taichi 1.7.4 itself never gives the memory of such an array back, and on Vulkan not always when asked to:
    for what is made again and again, such as for each scan, take an array of scalars.
    """
    array = ti.ndarray(Vec4, length)
    weakref.finalize(array, _free, array.arr).atexit = False
    return array


def _free(memory: Any) -> None:
    program = impl.get_runtime().prog
    if program is not None:
        program.delete_ndarray(memory)
