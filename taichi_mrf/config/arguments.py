"""Checks of the arguments of public functions: an error names the argument and shows what was passed.

A wrong type is an ArgumentTypeError (a TypeError), an impossible value an ArgumentError (a ValueError). Both
are ConfigErrors.
"""

import math
import numbers
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeVar

from taichi_mrf.config.values import shown
from taichi_mrf.errors import ArgumentError, ArgumentTypeError

if TYPE_CHECKING:  # a --help loads this file, and NumPy takes longer to load than all else that it needs
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

T = TypeVar("T")


def real(value: Any, name: str, least: float | None = None, above: float | None = None) -> float:
    """A number, at least ``least`` and more than ``above``; not NaN."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise ArgumentTypeError(f"{name} must be a number, not {shown(value)}")
    number = float(value)
    if least is not None and not number >= least:
        raise ArgumentError(f"{name} must be at least {least:g}, not {number}")
    if above is not None and not number > above:
        raise ArgumentError(f"{name} must be more than {above:g}, not {number}")
    return number


def seconds(value: Any, name: str) -> float:
    """A time in seconds: any finite number."""
    number = real(value, name)
    if not math.isfinite(number):
        raise ArgumentError(f"{name} must be a finite number of seconds, not {number}")
    return number


def whole(value: Any, name: str, least: int = 0) -> int:
    """A whole number, at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise ArgumentTypeError(f"{name} must be a whole number, not {shown(value)}")
    if value < least:
        raise ArgumentError(f"{name} must be at least {least}, not {value}")
    return int(value)


def instance(value: T, kind: Any, name: str, what: str) -> T:
    """A value of a class or protocol, which the error calls ``what``."""
    if not isinstance(value, kind):
        raise ArgumentTypeError(f"{name} must be {what}, not {shown(value)}")
    return value


def array(value: "ArrayLike", name: str) -> "NDArray[np.float64]":
    """An array of numbers, of any shape."""
    import numpy as np

    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentTypeError(f"{name} must be an array of numbers, not {shown(value)}") from error


def iterable(value: Any, name: str, what: str) -> list[Any]:
    """The values of a list or the like, which the error calls ``what``."""
    if not isinstance(value, Iterable) or isinstance(value, str):
        raise ArgumentTypeError(f"{name} must be {what}, not {shown(value)}")
    return list(value)
