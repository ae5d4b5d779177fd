"""Loops of kernels over the voxels of bricks: a strip of voxels for each iteration of the parallel loop.

On a CPU an iteration of a Taichi loop costs more than what is done to a voxel, and neighbouring voxels share
cache lines. On a GPU an iteration is a thread, and neighbouring threads should take neighbouring voxels.
"""

from taichi_mrf.kernels.types import I32, I32Array, Template
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import VOXELS

CPU_STRIP = 64
"""A divisor of VOXELS, so that a strip lies in one brick."""


def strip_length() -> int:
    """Voxels in a strip on the backend that runs."""
    return CPU_STRIP if runtime.active() == "cpu" else 1


@ti.func
def strip_begin(part: I32, slots: I32Array, strip: Template):
    """The first voxel of strip number ``part``: its place among the voxels of the bricks in ``slots``, and in
    the pool."""
    begin = part * strip
    return begin, slots[begin // VOXELS] * VOXELS + begin % VOXELS
