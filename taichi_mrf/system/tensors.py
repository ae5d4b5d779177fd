"""Arrays of other libraries as arguments: what speaks DLPack is read where it lies, and answers come back in
kind.

A tensor in the host's memory is read as a NumPy array of the same memory. One of torch's in a CUDA device's
memory goes to kernels as it is where Taichi runs on CUDA. No library is imported here: who passes a tensor
has done so.
"""

import dataclasses
import functools
import inspect
import math
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from taichi_mrf.errors import ArgumentTypeError, ConfigError
from taichi_mrf.system import runtime

F = TypeVar("F", bound=Callable[..., Any])

_HOST, _CUDA, _PINNED = 1, 2, 3
"""Devices by DLPack's numbers; pinned memory is the host's."""


def in_kind(*names: str, on_device: bool = False) -> Callable[[F], F]:
    """Let a function take tensors for its arguments ``names``, and return its arrays as such tensors.

    The function itself gets NumPy arrays; with ``on_device`` it also gets tensors in the memory of the device
    that Taichi runs on, which others get as copies. Arrays are returned by themselves, in a tuple or in a
    dataclass.
    """

    def decorate(function: F) -> F:
        places = {name: list(inspect.signature(function).parameters).index(name) for name in names}

        @functools.wraps(function)
        def call(*arguments: Any, **named: Any) -> Any:
            given = list(arguments)
            first: Any = None
            for name, place in places.items():
                where, key = (given, place) if place < len(given) else (named, name)
                if place < len(given) or name in named:
                    value = where[key]  # type: ignore[index]
                    if _is_tensor(value):
                        first = value if first is None else first
                        where[key] = _taken(value, name, on_device)  # type: ignore[index]
            answer = function(*given, **named)
            return answer if first is None else _in_kind(answer, first)

        return call  # type: ignore[return-value]

    return decorate


def on_host(value: Any, name: str) -> Any:
    """A tensor as a NumPy array, of the same memory if that is the host's; anything else as it is. Raises
    ArgumentTypeError for one that DLPack cannot read."""
    return _taken(value, name, False) if _is_tensor(value) else value


def numbers(value: Any, name: str) -> Any:
    """Numbers as a contiguous array of float32 or float64: the value itself if it is one, also in a device's
    memory. Raises ArgumentTypeError if it holds something else."""
    if _is_tensor(value):  # in the memory of Taichi's device
        given = value if value.dtype.itemsize in (4, 8) and value.is_floating_point() else value.double()
        return given.contiguous()
    try:
        given = np.asarray(value)
        return np.asarray(given, given.dtype if given.dtype in ("f4", "f8") else np.float64, order="C")
    except (TypeError, ValueError) as error:
        what = repr(value) if isinstance(value, str) else type(value).__name__
        raise ArgumentTypeError(f"{name} must be an array of numbers, not {what}") from error


def real_array(value: Any, name: str, shape: tuple[int | str, ...]) -> Any:
    """Numbers as :func:`numbers` gives them, of a shape; a name stands for any length. Raises ConfigError for
    another shape or numbers that are not finite."""
    given = numbers(value, name)
    if len(given.shape) != len(shape) or any(
        isinstance(want, int) and n != want for n, want in zip(given.shape, shape, strict=True)
    ):
        wanted = ", ".join(map(str, shape))
        raise ConfigError(f"{name} must be of shape ({wanted}), not {tuple(given.shape)}")
    check_finite(given, name)
    return given


def check_finite(given: Any, name: str) -> None:
    """Raises ConfigError for numbers that are not finite."""
    # One pass over the memory: a value that is not finite spoils the sum. So may many large ones.
    with np.errstate(over="ignore", invalid="ignore"):
        total = float(given.sum())
    if not math.isfinite(total) and not bool((abs(given) < math.inf).all()):
        raise ConfigError(f"{name} hold a value that is not finite")


def empty(like: Any, shape: tuple[int, ...], dtype: str = "float32") -> Any:
    """An array in the same memory as another."""
    if isinstance(like, np.ndarray):
        return np.empty(shape, dtype)
    return like.new_empty(tuple(shape), dtype=getattr(sys.modules["torch"], dtype))


def moved_to(like: Any, given: Any) -> Any:
    """An array in the memory of a device's tensor, which it may be itself."""
    return sys.modules["torch"].as_tensor(given, device=like.device)


def as_numpy(given: Any) -> Any:
    """An array in the host's memory."""
    return given if isinstance(given, np.ndarray) else given.cpu().numpy()


def as_int8(truth: Any) -> Any:
    """Truth values as 0 and 1, int8 of the same memory."""
    return truth.view(np.int8 if isinstance(truth, np.ndarray | np.generic) else sys.modules["torch"].int8)


def _is_tensor(value: Any) -> bool:
    return hasattr(value, "__dlpack__") and not isinstance(value, np.ndarray | np.generic)


def _taken(value: Any, name: str, on_device: bool) -> Any:
    device = int(value.__dlpack_device__()[0])
    if device not in (_HOST, _PINNED):
        if device != _CUDA or runtime.active() != "cuda" or not _is_torch(value):
            raise ArgumentTypeError(
                f"{name} lies in the memory of a device that Taichi, on {runtime.active() or 'no backend'}, "
                "does not read: pass a copy in the host's memory (torch: .cpu())"
            )
        if on_device:
            return value.detach()
        value = value.cpu()
    try:
        return np.from_dlpack(value)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise ArgumentTypeError(f"{name} cannot be read by DLPack: {' '.join(str(error).split())}") from error


def _is_torch(value: Any) -> bool:
    return type(value).__module__.partition(".")[0] == "torch"


def _in_kind(answer: Any, like: Any) -> Any:
    """The arrays of an answer as tensors of another's kind, on its device."""
    if isinstance(answer, np.ndarray | np.generic):
        return _converted(np.asarray(answer), like)
    if isinstance(answer, tuple):
        return tuple(_in_kind(each, like) for each in answer)
    if dataclasses.is_dataclass(answer) and not isinstance(answer, type):
        fields = {f.name: getattr(answer, f.name) for f in dataclasses.fields(answer) if f.init}
        arrays = {name: _in_kind(v, like) for name, v in fields.items() if isinstance(v, np.ndarray)}
        return dataclasses.replace(answer, **arrays)
    return answer


def _converted(array: Any, like: Any) -> Any:
    """An array of NumPy's by ``from_dlpack`` of the library that ``like`` is of; itself if that has none."""
    if hasattr(like, "__array_namespace__"):
        library = like.__array_namespace__()
    else:
        library = sys.modules.get(type(like).__module__.partition(".")[0])
    if not hasattr(library, "from_dlpack"):
        return array
    tensor = library.from_dlpack(array)
    return tensor if int(like.__dlpack_device__()[0]) != _CUDA else tensor.to(like.device)
