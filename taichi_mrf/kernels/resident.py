"""Arrays that the host fills once and kernels then read again and again, without waiting for the host."""

from typing import Any, TypeAlias

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from taichi.lang.util import to_taichi_type

from taichi_mrf.system import runtime

Resident: TypeAlias = "NDArray[Any] | ti.Ndarray"


def resident(values: NDArray[Any]) -> Resident:
    """The values where kernels reach them: on a CPU the array itself, which nobody may change from now on,
    elsewhere a copy in the device's memory."""
    values = np.ascontiguousarray(values)
    if runtime.active() == "cpu":
        return values
    array = ti.ndarray(to_taichi_type(values.dtype), values.shape)
    array.from_numpy(values)
    return array


def on_host(array: Resident) -> NDArray[Any]:
    """The values again, to be read only."""
    return array if isinstance(array, np.ndarray) else array.to_numpy()
