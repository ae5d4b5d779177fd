"""Marks: one bit for each voxel of a window, the least that can be remembered of every voxel.

A window's marks are an int32 array of 16 words for each of its bricks. They are made with Taichi and read
with NumPy.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.kernels.types import I32, I32Array, IVec3
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick
from taichi_mrf.voxels.numbering import flat, voxel_number
from taichi_mrf.voxels.window import Window

WORD = 32
"""Voxels in a word."""

WORDS = VOXELS // WORD
"""Words for a brick."""

Marks = NDArray[np.int32]


def no_marks(window: Window) -> ti.ndarray:
    """Marks for all voxels of a window, none of them set. Raises CapacityError if they would not fit."""
    what = f"a box of {window.cells * float(VOXELS):.3g} voxels of {window.voxel_size:g} m"
    if window.cells * VOXELS >= 2**31:
        raise CapacityError(f"{what} is too large to mark its voxels one by one; choose larger voxels")
    check_memory(window.cells * VOXELS / 8, what)
    marks = ti.ndarray(ti.i32, window.cells * WORDS)
    marks.fill(0)
    return marks


@ti.func
def mark(marks: I32Array, voxel: I32):
    """Mark a voxel, from the number of its brick in the window times 512 plus its own number there."""
    bit = ti.cast(1, ti.i32) << (voxel % WORD)
    if (marks[voxel // WORD] & bit) == 0:  # most are marked already, and reading is cheaper
        ti.atomic_or(marks[voxel // WORD], bit)


@ti.func
def voxel_in_window(cell: IVec3, shape: IVec3) -> I32:
    """The number that :func:`mark` takes, from a voxel's coordinates counted from the window's corner."""
    brick = cell // BRICK
    return flat(brick, shape) * VOXELS + voxel_number(cell - brick * BRICK)


def count(marks: Marks) -> int:
    """Number of voxels that are marked."""
    return sum(int(np.unpackbits(part.view(np.uint8)).sum()) for part in np.array_split(marks, _parts(marks)))


def marked_voxels(marks: Marks, window: Window) -> NDArray[np.int32]:
    """World coordinates of the marked voxels, (n, 3), in lexicographic order."""
    voxels = np.concatenate([np.zeros((0, 3), np.int32), *blocks(marks, window)])
    return voxels[np.lexsort(voxels.T[::-1])]


def blocks(marks: Marks, window: Window, bricks: int = 4096) -> Iterator[NDArray[np.int32]]:
    """World coordinates of the marked voxels, brick by brick, in arrays (n, 3) of some ``bricks`` each."""
    rows = marks.reshape(-1, WORDS)
    cells = np.flatnonzero(rows.any(axis=1)).astype(np.int32)
    offsets = offsets_in_brick()
    for first in range(0, len(cells), bricks):
        some = cells[first : first + bricks]
        # Little-endian words, lowest bit first: bits come out in the order of the voxels' numbers.
        bits = np.unpackbits(rows[some].astype("<i4").view(np.uint8), axis=1, bitorder="little")
        brick, voxel = np.nonzero(bits)
        yield window.bricks_of(some)[brick] * BRICK + offsets[voxel]


def _parts(marks: Marks) -> int:
    """Into how many parts to cut marks so that one unpacked is some megabytes."""
    return max(1, marks.nbytes >> 20)
