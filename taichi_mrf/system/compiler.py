"""The compiler of all kernels: Taichi, or Quadrants, its maintained fork. This module binds the name ``ti``.

    from taichi_mrf.system.compiler import ti

Kernels are written in the language that both have in common. TAICHI_MRF_COMPILER chooses one by name; without
it, it is Taichi if that is installed, else Quadrants. A process has one: the first choice holds.

What this package uses of their internals (Taichi 1.7.4, Quadrants 1.3.3) is named here and nowhere else.
Importing this module loads neither of them; the first use of ``ti`` does.
"""

import dataclasses
import functools
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from taichi_mrf.errors import BackendError

if TYPE_CHECKING:
    import numpy as np

VARIABLE = "TAICHI_MRF_COMPILER"


@dataclass(frozen=True)
class _Compiler:
    title: str
    install: str
    """Name of the package that pip installs."""
    prefix: str
    """Of its environment variables."""
    banner: str
    """The environment variable that keeps it from printing when it is loaded."""
    cache: tuple[str, ...]
    """Folder of its compiled kernels within XDG_CACHE_HOME."""
    runtime: str
    """The attribute of its module ``lang.impl`` that is the runtime."""
    program: str
    """The runtime's attribute that is None before ``ti.init``."""
    kernel: str
    """The module of the class of kernels."""
    made: str
    """Attribute of a kernel: what was made of its source, by the types of its arguments."""
    context: str
    """The class that walks through the source of a kernel."""
    note: str
    """Its method that makes the note of where an expression stands."""
    data_type: str
    """The function of ``lang.util`` that turns NumPy's types into the compiler's."""
    frees_vectors: bool
    """True if the memory of an array of vectors is freed with the array."""


COMPILERS = {
    "taichi": _Compiler(
        title="Taichi",
        install="'taichi>=1.7.4,<1.8'",
        prefix="TI_",
        banner="ENABLE_TAICHI_HEADER_PRINT",
        cache=("taichi", "ticache"),
        runtime="pytaichi",
        program="prog",
        kernel="lang.kernel_impl",
        made="compiled_kernels",
        context="ASTTransformerContext",
        note="get_pos_info",
        data_type="to_taichi_type",
        frees_vectors=False,
    ),
    "quadrants": _Compiler(
        title="Quadrants",
        install="'taichi-mrf[quadrants]'",
        prefix="QD_",
        banner="ENABLE_QUADRANTS_HEADER_PRINT",
        cache=("quadrants", "qdcache"),
        runtime="pyquadrants",
        program="_prog",
        kernel="lang.kernel",
        made="materialized_kernels",
        context="ASTTransformerFuncContext",
        note="memoized_get_pos_info",
        data_type="to_quadrants_type",
        frees_vectors=True,
    ),
}
"""In the order in which they are looked for."""


@functools.cache
def name() -> str:
    """The package that compiles the kernels of this process: "taichi" or "quadrants".

    Raises BackendError if there is none, or if TAICHI_MRF_COMPILER names one that is not there.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked:
        if asked not in COMPILERS:
            raise BackendError(f"unknown compiler '{asked}' in {VARIABLE}; use {', '.join(COMPILERS)}")
        if not _is_installed(asked):
            install = COMPILERS[asked].install
            raise BackendError(f"{VARIABLE} is '{asked}', which is not installed: pip install {install}")
        return asked
    for found in filter(_is_installed, COMPILERS):
        return found
    ways = " or ".join(f"pip install {compiler.install}" for compiler in COMPILERS.values())
    raise BackendError(f"no compiler of kernels is installed: {ways}")


def title() -> str:
    """The compiler's name in a sentence: "Taichi" or "Quadrants"."""
    return COMPILERS[name()].title


def variable(setting: str) -> str:
    """The environment variable of one of its settings, such as "OFFLINE_CACHE"."""
    return COMPILERS[name()].prefix + setting


def is_loaded() -> bool:
    """True if the compiler is in memory, loaded by this package or by the program around it."""
    return name() in sys.modules


def runtime_place() -> tuple[Any, str]:
    """The module that keeps the runtime, None before the compiler is loaded, and its attribute: the present
    runtime, which ``ti.init`` and ``ti.reset`` replace."""
    return sys.modules.get(f"{name()}.lang.impl"), COMPILERS[name()].runtime


def program() -> Any:
    """Object that runs kernels and owns the memory; None before ``ti.init``."""
    implementation, attribute = runtime_place()
    return getattr(getattr(implementation, attribute, None), COMPILERS[name()].program, None)


def kernel_class() -> Any:
    """The class of kernels, whose ``launch_kernel`` is called for each launch."""
    return _inner(COMPILERS[name()].kernel).Kernel


def kernels_of(kernel: Any) -> dict[Any, Any]:
    """The compiled forms of a kernel so far, by the types of its arguments."""
    made: dict[Any, Any] = getattr(kernel, COMPILERS[name()].made)
    return made


def argument_kind(annotation: Any) -> str:
    """The kind of a kernel's argument by its annotation: "template", "array" (of numbers), "vectors" (an
    array of them), "reals" and "wholes" (a vector or matrix), "float", "int" (signed), or "" for any other.
    Taichi alone."""
    types, matrix = _inner("types.primitive_types"), _inner("lang.matrix").MatrixType
    number = annotation.dtype if isinstance(annotation, matrix) else annotation
    kind = ""
    if isinstance(annotation, _inner("types.annotations").template):
        kind = "template"
    elif isinstance(annotation, _inner("types.ndarray_type").NdarrayType):
        element = annotation.dtype
        kind = ("vectors" if element.ndim == 1 else "") if isinstance(element, matrix) else "array"
    elif id(number) in types.real_type_ids:
        kind = "float" if number is annotation else "reals"
    elif id(number) in (id(types.i32), id(types.i64)):
        kind = "int" if number is annotation else "wholes"
    return kind


def run(compiled: Any, context: Any) -> None:
    """Launch a kernel that was launched before, with the arguments of a context. Taichi alone."""
    running = program()
    try:
        ready = running.compile_kernel(running.config(), running.get_device_caps(), compiled)
        running.launch_kernel(ready, context)
    except Exception as error:
        raise _inner("lang.exception").handle_exception_from_cpp(error) from None


def note_maker() -> tuple[Any, str]:
    """The class that notes where expressions stand in the source, and the name of its method for it."""
    compiler = COMPILERS[name()]
    return getattr(_inner("lang.ast.ast_transformer_utils"), compiler.context), compiler.note


def decorators() -> Any:
    """The module of ``ti.func`` and ``ti.kernel``."""
    return _inner("lang.kernel_impl")


def arrays() -> Any:
    """The module of ``ti.Ndarray``."""
    return _inner("lang._ndarray")


def compilation_error() -> type[Exception]:
    """The exception for source that is not in the language."""
    return getattr(_inner("lang.exception"), f"{title()}CompilationError")


def data_type(dtype: "np.dtype[Any]") -> Any:
    """The compiler's type of a NumPy type."""
    convert: Callable[[Any], Any] = getattr(_inner("lang.util"), COMPILERS[name()].data_type)
    return convert(dtype)


def function_mark() -> str:
    """The attribute by which the compiler tells its own functions from others, of which it warns."""
    return f"_is_{name()}_function"


def pass_whole(base: type) -> None:
    """Have functions of the language take a dataclass of this base as one argument. Quadrants would hand over
    its fields one by one, which fits only where the parameter is annotated with the dataclass itself."""
    if name() != "quadrants":
        return

    def is_dataclass(value: Any) -> bool:
        kind = value if isinstance(value, type) else type(value)
        return dataclasses.is_dataclass(kind) and not issubclass(kind, base)

    calls = _inner("lang.ast.ast_transformers.call_transformer")
    calls.dataclasses = SimpleNamespace(is_dataclass=is_dataclass, fields=dataclasses.fields)


def frees_vectors() -> bool:
    """True if the memory of an array of vectors is freed with the array."""
    return COMPILERS[name()].frees_vectors


def _is_installed(package: str) -> bool:
    found = importlib.util.find_spec(package)
    return found is not None and found.origin is not None  # a folder of that name has no origin


@functools.cache
def _inner(module: str) -> Any:
    return importlib.import_module(f"{name()}.{module}")


def __getattr__(wanted: str) -> Any:
    if wanted != "ti":
        raise AttributeError(f"module '{__name__}' has no attribute '{wanted}'")
    globals()[wanted] = importlib.import_module(name())
    return globals()[wanted]
