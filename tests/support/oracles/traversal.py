"""Rays through a grid of cubes: cut at every face, sorted. Nothing is stepped and nothing is accumulated."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]
Cells = NDArray[np.int64]


def clip_to_box(
    origin: ArrayLike, direction: ArrayLike, begin: float, end: float, lower: ArrayLike, upper: ArrayLike
) -> tuple[float, float]:
    """The part of [begin, end] where origin + t * direction lies in the half-open box; empty if none."""
    for o, d, low, high in zip(
        np.asarray(origin, np.float64), np.asarray(direction, np.float64), np.asarray(lower, np.float64),
        np.asarray(upper, np.float64), strict=True,
    ):  # fmt: skip
        if d == 0:
            if not low <= o < high:
                return begin, begin
        else:
            first, last = sorted(((low - o) / d, (high - o) / d))
            begin, end = max(begin, first), min(end, last)
    return begin, end


def segments(
    origin: ArrayLike, direction: ArrayLike, begin: float, end: float, size: float = 1.0
) -> tuple[Cells, Vector, Vector]:
    """The cells of a grid along a ray: (n, 3) cells, and the t at which each is entered and left, (n,).

    Cell (i, j, k) is the half-open cube from (i, j, k) * size on. Cells that the ray only touches are
    left out.
    """
    origin_, direction_ = np.asarray(origin, np.float64) / size, np.asarray(direction, np.float64) / size
    if begin >= end:
        return np.zeros((0, 3), np.int64), np.zeros(0), np.zeros(0)
    cuts = [np.array([begin, end])]
    for o, d in zip(origin_, direction_, strict=True):
        if d != 0:
            first, last = sorted((o + begin * d, o + end * d))
            cuts.append((np.arange(np.floor(first), np.ceil(last) + 1) - o) / d)
    t = np.unique(np.concatenate(cuts))
    t = t[(t >= begin) & (t <= end)]
    # Faces that an edge or a corner has in common differ by rounding only.
    near, far = t[:-1], t[1:]
    real = (far - near) * np.linalg.norm(direction_) > 1e-9
    near, far = near[real], far[real]
    middle = 0.5 * (near + far)
    return np.floor(origin_ + middle[:, None] * direction_).astype(np.int64), near, far
