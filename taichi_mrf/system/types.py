"""Argument types of Taichi kernels, spelt once.

Taichi reads them at run time, where they are values and not types; a type checker sees types that allow
everything.
"""

from typing import TYPE_CHECKING, Any, TypeAlias

from taichi_mrf.system.compiler import ti

if TYPE_CHECKING:
    Template: TypeAlias = Any
    F32: TypeAlias = Any
    F64: TypeAlias = Any
    I32: TypeAlias = Any
    Mat3: TypeAlias = Any
    AnyArray: TypeAlias = Any
    AnyArray2: TypeAlias = Any
    I32Array: TypeAlias = Any
    I64Array: TypeAlias = Any
    F64Array: TypeAlias = Any
    F32Array: TypeAlias = Any
    I32Array2: TypeAlias = Any
    F32Array2: TypeAlias = Any
    F32Array3: TypeAlias = Any
    Vec4Array: TypeAlias = Any

    class Struct(Any): ...

    class Vec2(Any): ...

    class Vec3(Any): ...

    class Vec4(Any): ...

    class Vec5(Any): ...

    class DVec3(Any): ...

    class IVec3(Any): ...

    class IVec4(Any): ...

    class IVec8(Any): ...

else:
    Template = ti.template()
    Struct = object
    F32 = ti.f32
    F64 = ti.f64
    I32 = ti.i32
    Vec2 = ti.types.vector(2, ti.f32)
    Vec3 = ti.types.vector(3, ti.f32)
    Vec4 = ti.types.vector(4, ti.f32)
    Vec5 = ti.types.vector(5, ti.f32)
    DVec3 = ti.types.vector(3, ti.f64)
    IVec3 = ti.types.vector(3, ti.i32)
    IVec4 = ti.types.vector(4, ti.i32)
    IVec8 = ti.types.vector(8, ti.i32)
    Mat3 = ti.types.matrix(3, 3, ti.f32)
    AnyArray = ti.types.ndarray()
    AnyArray2 = ti.types.ndarray(ndim=2)
    I32Array = ti.types.ndarray(dtype=ti.i32, ndim=1)
    I64Array = ti.types.ndarray(dtype=ti.i64, ndim=1)
    F64Array = ti.types.ndarray(dtype=ti.f64, ndim=1)
    F32Array = ti.types.ndarray(dtype=ti.f32, ndim=1)
    I32Array2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
    F32Array2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
    F32Array3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
    Vec4Array = ti.types.ndarray(dtype=Vec4, ndim=1)
