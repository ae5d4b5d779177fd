"""Each backend gives the CPU's map: at least 99.9% of voxels within 0.02 of probability."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import small_room


@pytest.mark.backends
def test_this_backend_agrees_with_the_cpu(backend: str, tmp_path: Path) -> None:
    if backend == "cpu":
        pytest.skip("the CPU is what the other backends are compared with (pytest --arch vulkan, cuda)")
    out = tmp_path / "cpu.npy"
    program = Path(small_room.__file__)
    subprocess.run([sys.executable, str(program), "cpu", str(out)], check=True, cwd=program.parent)
    expected = np.load(out)
    got = small_room.build(list(range(5))).occupancy(small_room.probes())
    assert (expected > 0.5).sum() > 1000
    assert (np.abs(got - expected) <= 0.02).mean() >= 0.999
