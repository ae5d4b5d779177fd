"""Argument types of Taichi kernels, spelt once.

Taichi reads them at run time and they are values, not types; a type checker is shown classes that
allow everything.
"""

from typing import TYPE_CHECKING, Any

import taichi as ti

if TYPE_CHECKING:

    class Template(Any): ...

    class Struct(Any): ...

    class F32(Any): ...

    class I32(Any): ...

    class Vec3(Any): ...

    class Vec4(Any): ...

    class Vec5(Any): ...

    class IVec3(Any): ...

    class IVec4(Any): ...

    class Mat3(Any): ...

    class AnyArray(Any): ...

    class I32Array(Any): ...

    class I64Array(Any): ...

    class F32Array(Any): ...

    class F32Array2(Any): ...

    class F32Array3(Any): ...

    class Vec4Array(Any): ...

else:
    Template = ti.template()
    Struct = object
    F32 = ti.f32
    I32 = ti.i32
    Vec3 = ti.types.vector(3, ti.f32)
    Vec4 = ti.types.vector(4, ti.f32)
    Vec5 = ti.types.vector(5, ti.f32)
    IVec3 = ti.types.vector(3, ti.i32)
    IVec4 = ti.types.vector(4, ti.i32)
    Mat3 = ti.types.matrix(3, 3, ti.f32)
    AnyArray = ti.types.ndarray()
    I32Array = ti.types.ndarray(dtype=ti.i32, ndim=1)
    I64Array = ti.types.ndarray(dtype=ti.i64, ndim=1)
    F32Array = ti.types.ndarray(dtype=ti.f32, ndim=1)
    F32Array2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
    F32Array3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
    Vec4Array = ti.types.ndarray(dtype=Vec4, ndim=1)
