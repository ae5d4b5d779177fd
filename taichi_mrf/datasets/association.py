"""Pairing the stamps of two clocked streams, such as depth images and poses."""

from collections.abc import Sequence

import numpy as np


def associate(stamps: Sequence[float], others: Sequence[float], largest_gap: float) -> list[int | None]:
    """For each stamp (seconds) the index of its partner in ``others``, or None.

    No pair is further apart than ``largest_gap``, no partner is given twice, and the closest pairs are
    made first. Neither list needs to be sorted.
    """
    order = np.argsort(others, kind="stable")
    ordered = np.asarray(others, dtype=np.float64)[order]
    pairs = []
    for i, stamp in enumerate(stamps):
        # A little wider than the gap, so that the rounding of stamp +- gap decides nothing.
        window = largest_gap + 2 * np.spacing(abs(stamp) + largest_gap)
        first = np.searchsorted(ordered, stamp - window, side="left")
        last = np.searchsorted(ordered, stamp + window, side="right")
        for j in range(first, last):
            gap = abs(stamp - ordered[j])
            if gap <= largest_gap:
                pairs.append((gap, i, int(order[j])))
    partner: list[int | None] = [None] * len(stamps)
    taken = set()
    for _, i, j in sorted(pairs):
        if partner[i] is None and j not in taken:
            partner[i] = j
            taken.add(j)
    return partner
