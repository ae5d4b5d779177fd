"""Pairing stamps: no gap too large, nobody twice, the closest first."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.datasets.formats.tum_rgbd import associate

# No subnormal numbers: Taichi's kernels make the processor take them for zero.
stamps = st.lists(st.floats(0, 2, allow_subnormal=False), max_size=30)


def greedy_oracle(a: list[float], b: list[float], gap: float) -> list[int | None]:
    """All pairs by their difference, each taken if both are free."""
    pairs = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= gap)
    out: list[int | None] = [None] * len(a)
    for _, i, j in pairs:
        if out[i] is None and j not in out:
            out[i] = j
    return out


@given(stamps, stamps, st.floats(0, 0.5, allow_subnormal=False))
def test_equals_trying_all_pairs(a: list[float], b: list[float], gap: float) -> None:
    assert associate(a, b, gap) == greedy_oracle(a, b, gap)


def test_stamps_since_1970_keep_their_milliseconds() -> None:
    start = 1305031102.0
    depth = [start + 0.160407, start + 0.194330, start + 0.226738]
    poses = start + np.arange(0, 0.4, 0.01)
    partners = associate(depth, poses.tolist(), 0.02)
    assert partners == [16, 19, 23]
