"""Repeated launches of a kernel set its arguments, and do no more.

Taichi 1.7.4 looks at each argument of each launch as if it were the first: it asks a dozen questions about
its type, and makes each vector three times. For the 40 arguments of a sweep's rays that takes longer than
many a kernel. Here a kernel is asked once how its arguments are set. A launch looks up the compiled kernel by
the types of its arrays and by its templates, and sets the arguments.

Taichi itself makes the first launch with such arguments, launches kernels that return values or print, takes
tensors of other libraries and arrays that are not contiguous, and tells of mistakes.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from taichi_mrf.system import compiler

Decide = Callable[[Any], object]
"""The property of an argument that decides which compiled kernel is launched."""

SetArgument = Callable[[Any, Any], None]
"""Sets the argument of a kernel, in the context of its launch."""

_MOST = 2**31 - 1
"""Numbers in an array of NumPy's at most; Taichi warns of larger ones."""


class _LeftToTaichiError(Exception):
    """An argument that is of no usual kind."""


class _Plan:
    """Setters for the arguments of one kernel, and its compiled forms."""

    def __init__(self, kernel: Any, kinds: list[str]) -> None:
        self.made: Any = None  # the kernel's own table of ``known``; it has another one after ``ti.reset``
        self.known: dict[tuple[object, ...], Any] = {}
        self.deciding: list[tuple[int, Decide]] = []
        self.setting: list[tuple[int, SetArgument]] = []
        for i, (argument, kind) in enumerate(zip(kernel.arguments, kinds, strict=True)):
            if kind == "template":
                self.deciding.append((i, _template(kernel, argument.annotation)))
                continue
            slot = len(self.setting)
            if kind in ("array", "vectors"):
                self.deciding.append((i, _type_of))
                self.setting.append((i, _array(slot, int(kind == "vectors"))))
            elif kind in ("reals", "wholes"):
                self.setting.append((i, _matrix(slot, argument.annotation, kind == "reals")))
            else:
                self.setting.append((i, _number(slot, kind == "float")))


def hasten() -> None:
    """Launch so from now on, also the kernels of other packages. Quadrants has a way of its own."""
    if compiler.name() != "taichi":
        return
    kernels = compiler.kernel_class()
    by_taichi = kernels.__call__

    def launch(self: Any, *arguments: Any, **named: Any) -> Any:
        try:
            plan = self.quick_plan
        except AttributeError:
            plan = self.quick_plan = _plan_for(self)
        if plan is None or named or len(arguments) != len(self.arguments):
            return by_taichi(self, *arguments, **named)
        if plan.made is not self.compiled_kernels:
            plan.made, plan.known = self.compiled_kernels, {}
        try:
            which = tuple([decide(arguments[i]) for i, decide in plan.deciding])
            compiled = plan.known.get(which)
            if compiled is not None:
                context = compiled.make_launch_context()
                for i, set_argument in plan.setting:
                    set_argument(context, arguments[i])
        except _LeftToTaichiError:
            return by_taichi(self, *arguments)
        if compiled is not None:
            return compiler.run(compiled, context)
        answer = by_taichi(self, *arguments)
        if not self.has_print:
            key = (self.func, self.mapper.lookup(arguments)[0], self.autodiff_mode)
            plan.known[which] = self.compiled_kernels[key]
        return answer

    kernels.__call__ = launch


def _plan_for(kernel: Any) -> _Plan | None:
    """None for a kernel that returns something, is a derivative, or has an argument of another kind."""
    kinds = [compiler.argument_kind(argument.annotation) for argument in kernel.arguments]
    usual = kernel.return_type is None and kernel.autodiff_mode.name == "NONE" and all(kinds)
    return _Plan(kernel, kinds) if usual else None


def _template(kernel: Any, annotation: Any) -> Decide:
    extract = kernel.mapper.extract_arg
    return lambda value: value if type(value) in (int, bool, float) else extract(value, annotation, "")


def _type_of(array: Any) -> object:
    if type(array) is np.ndarray:
        return array.dtype, array.ndim
    if not isinstance(array, compiler.arrays().Ndarray) or array.grad is not None:
        raise _LeftToTaichiError
    return array.element_type, len(array.shape)


def _number(slot: int, real: bool) -> SetArgument:
    usual = (float, int, np.floating, np.integer) if real else (int, np.integer)

    def set_number(context: Any, value: Any) -> None:
        if not isinstance(value, usual):
            raise _LeftToTaichiError
        if real:
            context.set_arg_float((slot,), float(value))
        else:
            context.set_arg_int((slot,), int(value))

    return set_number


def _array(slot: int, of_vectors: int) -> SetArgument:
    def set_array(context: Any, array: Any) -> None:
        if type(array) is not np.ndarray:
            context.set_arg_ndarray((slot,), array.arr)
        elif array.flags.c_contiguous and array.size <= _MOST:
            place, shape = array.__array_interface__["data"][0], array.shape[: array.ndim - of_vectors]
            context.set_arg_external_array_with_shape((slot,), place, array.nbytes, shape, 0)
        else:
            raise _LeftToTaichiError

    return set_array


def _matrix(slot: int, annotation: Any, real: bool) -> SetArgument:
    slots = [(slot, i) for i in range(annotation.n * annotation.m)]
    usual = (float, int) if real else (int,)

    def set_matrix(context: Any, value: Any) -> None:
        entries = getattr(value, "entries", value)
        if type(entries) is np.ndarray:
            entries = entries.ravel().tolist()
        if len(entries) != len(slots) or not all(type(entry) in usual for entry in entries):
            raise _LeftToTaichiError
        set_entry = context.set_struct_arg_float if real else context.set_struct_arg_int
        for at, entry in zip(slots, entries, strict=True):
            set_entry(at, entry)

    return set_matrix
