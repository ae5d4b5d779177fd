"""Arrays of vectors: zero at first, and given back when they are dropped.

As a program it makes and drops 43 arrays on the CPU and prints how the resident memory grew after the
third: in a process of its own, where nothing else moves it.
"""

import gc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.system import runtime
from taichi_mrf.system.resident import vec4_array

pytestmark = pytest.mark.compilers

STATM = Path("/proc/self/statm")
LENGTH = 1_000_000
ARRAY_MB = 16.0 * LENGTH / 1e6


def test_it_is_an_array_of_zeros(backend: str) -> None:
    array = vec4_array(7)
    np.testing.assert_array_equal(array.to_numpy(), np.zeros((7, 4), np.float32))


@pytest.mark.skipif(not STATM.exists(), reason="resident memory is read from /proc, which only Linux has")
def test_dropped_arrays_give_their_memory_back() -> None:
    found = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    assert float(found.stdout.splitlines()[-1]) < 4 * ARRAY_MB


def resident_mb() -> float:
    return int(STATM.read_text().split()[1]) * 4096 / 1e6


if __name__ == "__main__":
    runtime.init("cpu")
    before = 0.0
    for number in range(43):
        array = vec4_array(LENGTH)
        array.fill(1.0)
        del array
        gc.collect()  # Taichi's arrays of vectors hold references to themselves
        if number == 2:
            before = resident_mb()
    print(resident_mb() - before)
