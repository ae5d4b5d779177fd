"""Arrays for kernels: those that are filled once, by the host or by a kernel, and arrays of vectors that give
their memory back.

Kernels read the first again and again without waiting for the host. The second are freed when Python collects
them, as Taichi's arrays of scalars are.
"""

import weakref
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

from taichi_mrf.system import compiler, runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import Vec4

Resident: TypeAlias = "NDArray[Any] | ti.Ndarray"


def resident(values: NDArray[Any]) -> Resident:
    """The values where kernels reach them: on a CPU the array itself, which must not change from now on,
    elsewhere a copy in the device's memory."""
    values = np.ascontiguousarray(values)
    if runtime.active() == "cpu":
        return values
    array = ti.ndarray(compiler.data_type(values.dtype), values.shape)
    array.from_numpy(values)
    return array


def zeros(dtype: DTypeLike, length: int) -> Resident:
    """An array (length) of zeros for kernels to write to, as each new one of Taichi's is; on a CPU it is
    NumPy's, which is made sooner."""
    if runtime.active() == "cpu":
        return np.zeros(length, dtype)
    return ti.ndarray(compiler.data_type(np.dtype(dtype)), length)


def on_host(array: Resident) -> NDArray[Any]:
    """The values again, to be read only."""
    return array if isinstance(array, np.ndarray) else array.to_numpy()


def vec4_array(length: int) -> "ti.Ndarray":
    """An array of 4-vectors of float32, all zero.

    Taichi 1.7.4 itself never gives the memory of such an array back, and on Vulkan not always when asked to:
    for what is made again and again, such as for each scan, take an array of scalars.
    """
    array = ti.ndarray(Vec4, length)
    if not compiler.frees_vectors():
        weakref.finalize(array, _free, array.arr).atexit = False
    return array


def _free(memory: Any) -> None:
    program = compiler.program()
    if program is not None:
        program.delete_ndarray(memory)
