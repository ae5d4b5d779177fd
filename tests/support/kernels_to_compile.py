"""Kernels that only one test launches, each."""

from taichi_mrf.system import bundles  # noqa: F401 (launches are watched)
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32Array


@ti.kernel
def double(values: F32Array):  # noqa: ANN201 (Taichi allows no None)
    for i in range(values.shape[0]):
        values[i] *= 2.0


@ti.kernel
def triple(values: F32Array):  # noqa: ANN201
    for i in range(values.shape[0]):
        values[i] *= 3.0


@ti.kernel
def quadruple(values: F32Array):  # noqa: ANN201
    for i in range(values.shape[0]):
        values[i] *= 4.0
