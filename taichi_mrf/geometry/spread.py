"""Points in an order in which the first few are already spread over all of them."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray


def furthest_first(
    points: Sequence[NDArray[np.float64]], taken: Sequence[NDArray[np.float64]]
) -> Iterator[int]:
    """Yield the places of ``points``, n of (d,), each time that of the point furthest from those ``taken``, m
    of (d,), and from those yielded before; the first of them for equal distances."""
    if len(points) == 0:
        return
    left = np.array(points)
    apart = np.full(len(left), np.inf)
    for point in taken:
        apart = np.minimum(apart, np.linalg.norm(left - point, axis=1))
    for _ in range(len(left)):
        place = int(np.argmax(apart))
        yield place
        apart = np.minimum(apart, np.linalg.norm(left - left[place], axis=1))
        apart[place] = -1.0  # not again
