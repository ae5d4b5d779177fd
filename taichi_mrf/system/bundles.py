"""Bundles: dataclasses that group the arguments of kernels, so that a kernel takes five and not forty.

A bundle is a frozen dataclass whose fields have the types of kernel arguments (kernels/types.py), or are
bundles themselves. The host fills it; a kernel reads its fields by name, and may call its ``ti.func``
methods:

    @dataclass(frozen=True)
    class Viewpoint(Bundle):
        centre: Vec3
        to_voxels: Mat3

    @kernel
    def follow(view: Viewpoint, depth: F32Array):
        for i in range(depth.shape[0]):
            ...view.centre...

    follow(Viewpoint(centre, to_voxels), depth)

Taichi itself sees a kernel with one argument for each field: grouping changes neither the compiled code nor
its speed. (Taichi 1.7.4's own argument packs take no NumPy arrays and one device buffer for each call; its
structs as arguments take no arrays, are 40% slower on Vulkan, and round differently on a CPU.)

What a bundle *is* decides what is compiled: a kernel that is called with another class of bundle in the same
place is compiled anew, with that class's methods. Such a class is how a sensor plugs into all kernels.
Inside kernels bundles group local variables and arguments just the same.
"""

import dataclasses
import functools
import inspect
import linecache
from collections.abc import Callable
from typing import Any, TypeVar

from taichi_mrf.system import compiler, quick_launch, quick_start
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import Template

quick_start.hasten()
quick_launch.hasten()


class Bundle:
    """The base of all bundles."""

    _data_oriented = True  # Taichi passes such an object on as it is


setattr(Bundle, compiler.function_mark(), False)  # Taichi would warn where a kernel makes one
compiler.pass_whole(Bundle)


class _Flat:
    """A Taichi kernel with one argument for each field, made for one combination of classes of bundles."""

    def __init__(self, body: Callable[..., None], types: dict[str, Any], arguments: tuple[Any, ...]) -> None:
        self._names: dict[str, Any] = {"_body": ti.func(body)}
        self._parameters: list[str] = []
        grouped = [
            self._regroup(name, annotation, value)
            for (name, annotation), value in zip(types.items(), arguments, strict=True)
        ]
        source = f"def {body.__name__}({', '.join(self._parameters)}):\n    _body({', '.join(grouped)})\n"
        # Taichi reads a kernel's source text, which it finds here.
        file = f"<{body.__module__}.{body.__name__} for {id(self)}>"
        linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
        exec(compile(source, file, "exec"), self._names)
        self.kernel = ti.kernel(self._names[body.__name__])

    def _regroup(self, name: str, annotation: Any, value: Any) -> str:
        """The expression that makes an argument of the body from the flat parameters."""
        if isinstance(value, Bundle):
            cls = f"_class_{name}"
            self._names[cls] = type(value)
            fields = dataclasses.fields(value)  # type: ignore[arg-type]
            inner = [self._regroup(f"{name}_{f.name}", f.type, getattr(value, f.name)) for f in fields]
            return f"{cls}({', '.join(inner)})"
        self._names[f"_type_{name}"] = annotation
        self._parameters.append(f"{name}: _type_{name}")
        return name


Body = TypeVar("Body", bound=Callable[..., None])


def kernel(body: Body) -> Body:
    """Make a kernel of a function whose arguments may be bundles.

    Arrays, vectors, scalars and templates are annotated as for ``ti.kernel``. The body is compiled as a
    ``ti.func`` whose arguments are passed by reference; its outermost loop is parallel.
    """
    signature = inspect.signature(body)
    types = {name: parameter.annotation for name, parameter in signature.parameters.items()}
    body.__annotations__ = dict.fromkeys(types, Template)
    made: dict[tuple[type, ...], Any] = {}

    def launch(*arguments: Any, **named: Any) -> None:
        if named or len(arguments) != len(types):
            arguments = signature.bind(*arguments, **named).args
        classes: list[type] = []
        flat: list[Any] = []
        for argument in arguments:
            _flatten(argument, classes, flat)
        key = tuple(classes)
        if key not in made:
            made[key] = _Flat(body, types, arguments).kernel
        made[key](*flat)

    launch.__name__, launch.__doc__, launch.__module__ = body.__name__, body.__doc__, body.__module__
    return launch


def _flatten(value: Any, classes: list[type], flat: list[Any]) -> None:
    """Append the fields of a bundle, and of the bundles in it, to ``flat``."""
    if isinstance(value, Bundle):
        classes.append(type(value))
        for name in _field_names(type(value)):  # type: ignore[arg-type]
            _flatten(getattr(value, name), classes, flat)
    else:
        flat.append(value)


@functools.cache
def _field_names(cls: Any) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(cls))
