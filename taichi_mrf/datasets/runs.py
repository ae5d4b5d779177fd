"""Several runs in one recording: a clock that starts again, as a simulation's that is reset."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError

RESTART_S = 1.0
"""A clock that goes back by more than this starts again; by less, messages came out of order."""


def starts_of_runs(stamps: Sequence[float] | NDArray[np.float64]) -> list[int]:
    """The indices at which runs begin, the first 0, of stamps (seconds) in the order of recording. A single
    stamp that is off, between two that follow each other, begins none."""
    s = np.asarray(stamps, np.float64)
    back: list[int] = (np.flatnonzero(s[1:] < s[:-1] - RESTART_S) + 1).tolist()
    return [0] * bool(len(s)) + [i for i in back if not (_is_off(s, i - 1) or _is_off(s, i))]


def _is_off(stamps: NDArray[np.float64], i: int) -> bool:
    """True if the stamp after this one follows the one before it."""
    return bool(0 < i < len(stamps) - 1 and stamps[i + 1] > stamps[i - 1])


def choose_run(
    stamps: Sequence[float] | NDArray[np.float64], wanted: int, where: str, what: str
) -> tuple[int, list[int], list[str]]:
    """The number, from 0, of the run that the user wants (from 1; 0 is the longest), the bounds of all runs,
    and a note that names the others. ``where`` is the recording, ``what`` has stamps, such as images. Raises
    DatasetError if there is no such run."""
    bounds = [*starts_of_runs(stamps), len(stamps)]
    parts = list(pairwise(bounds))
    words = [
        f"run {i + 1} ({stamps[first]:.3f} to {stamps[stop - 1]:.3f} s, {stop - first} {what})"
        for i, (first, stop) in enumerate(parts)
    ]
    if not 0 <= wanted <= len(parts):
        raise DatasetError(f"{where}: there is no run {wanted}; it has {', '.join(words)}")
    number = wanted - 1 if wanted else max(range(len(parts)), key=lambda i: parts[i][1] - parts[i][0])
    if len(parts) == 1:
        return number, bounds, []
    others = ", ".join(each for i, each in enumerate(words) if i != number)
    return (
        number,
        bounds,
        [f"the clock starts again: of {words[number]} and {others}, the first named is read (?run=N)"],
    )
