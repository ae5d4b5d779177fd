"""Argument types of Taichi kernels, spelt once.

Taichi reads them at run time; a type checker cannot, so it is shown ``Any``.
"""

from typing import TYPE_CHECKING, Any

import taichi as ti

if TYPE_CHECKING:
    I32Array = F32Array = F16Array = I64Array = F32Array2 = F32Array3 = Vec4Array = Any
    Vec3 = IVec3 = Vec4 = Mat3 = AnyArray = F32 = I32 = Any
else:
    F32 = ti.f32
    I32 = ti.i32
    I32Array = ti.types.ndarray(dtype=ti.i32, ndim=1)
    I64Array = ti.types.ndarray(dtype=ti.i64, ndim=1)
    F32Array = ti.types.ndarray(dtype=ti.f32, ndim=1)
    F16Array = ti.types.ndarray(dtype=ti.f16, ndim=1)
    F32Array2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
    F32Array3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
    AnyArray = ti.types.ndarray()
    Vec3 = ti.types.vector(3, ti.f32)
    IVec3 = ti.types.vector(3, ti.i32)
    Vec4 = ti.types.vector(4, ti.f32)
    Mat3 = ti.types.matrix(3, 3, ti.f32)
    Vec4Array = ti.types.ndarray(dtype=Vec4, ndim=1)
