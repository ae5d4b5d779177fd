"""Which keyframes have seen the same places: an index from coarse cells of space to keyframes."""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray


class SharedViews:
    """The cells (n,) that each keyframe has measured something in, by id."""

    def __init__(self, cells: Mapping[int, NDArray[np.int64]] = {}) -> None:
        self._seen_by: defaultdict[int, list[int]] = defaultdict(list)
        for id, keys in cells.items():
            self.add(id, keys)

    def add(self, id: int, cells: NDArray[np.int64]) -> None:
        """Add a keyframe that is not in the index."""
        for key in cells.tolist():
            self._seen_by[key].append(id)

    def shares(self, cells: NDArray[np.int64]) -> dict[int, float]:
        """The share of some cells that each keyframe has seen, if it has seen any."""
        counts: defaultdict[int, int] = defaultdict(int)
        for key in cells.tolist():
            for id in self._seen_by.get(key, ()):
                counts[id] += 1
        return {id: count / len(cells) for id, count in counts.items()}

    def partners(self, cells: NDArray[np.int64], most: int, least: float, without: int) -> list[int]:
        """Those keyframes that have seen most of some cells, ``most`` of them at most, each at least the
        share ``least``; not keyframe ``without``."""
        shares = self.shares(cells)
        known = [id for id, share in shares.items() if id != without and share >= least]
        return sorted(known, key=lambda id: (-shares[id], -id))[:most]
