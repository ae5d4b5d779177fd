"""Arrays of vectors: zero at first, and given back when they are dropped."""

from pathlib import Path

import numpy as np
import pytest

from taichi_mrf import runtime
from taichi_mrf.voxels.vectors import vec4_array

pytestmark = pytest.mark.usefixtures("backend")

STATM = Path("/proc/self/statm")


def resident_mb() -> float:
    return int(STATM.read_text().split()[1]) * 4096 / 1e6


def test_it_is_an_array_of_zeros() -> None:
    array = vec4_array(7)
    np.testing.assert_array_equal(array.to_numpy(), np.zeros((7, 4), np.float32))


@pytest.mark.skipif(not STATM.exists(), reason="resident memory is read from /proc, which only Linux has")
def test_dropped_arrays_give_their_memory_back(backend: str) -> None:
    if backend == "vulkan":
        pytest.skip("Taichi on Vulkan gives arrays back late, some never")
    one_mb = 16.0 * 1_000_000 / 1e6
    before = 0.0
    for number in range(43):
        array = vec4_array(1_000_000)
        array.fill(1.0)
        runtime.settle()  # before it is dropped, as everywhere
        del array
        if number == 2:
            before = resident_mb()
    assert resident_mb() - before < 4 * one_mb
