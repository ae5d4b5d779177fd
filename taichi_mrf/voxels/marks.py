"""Marks: one bit for each voxel of a window, the least that can be remembered of every voxel.

A window's marks are an int32 array of 16 words for each of its bricks. They are made with Taichi and read
with NumPy.

A triangle marks the voxels whose box it overlaps, exactly. Schwarz and Seidel (2010): they overlap if and
only if the box meets the triangle's plane and bounding box, and their projections along each of the three
axes overlap. A triangle is taken apart into rows of columns of voxels along the axis that it faces most: a
column meets its plane in three voxels at most, and the rows of a huge triangle are work for many.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.types import F32, I32, F32Array3, I32Array, IVec3, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick
from taichi_mrf.voxels.numbering import flat, voxel_number
from taichi_mrf.voxels.traversal import within
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


def mark_triangles(
    corners_m: NDArray[np.float64], window: Window, marks: ti.ndarray, grown: float = 0.0
) -> None:
    """Mark the voxels of a window that triangles with these corners, (T, 3, 3) in metres, pass through.

    A voxel is the half-open box that it is everywhere: a triangle in the plane between two voxels passes
    through the upper one. ``grown`` is by how much, in voxels, the voxel's box is larger on every side.
    Triangles without an area are left out.
    """
    corners = window.to_voxels(corners_m)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    inside = (corners.max(axis=1) >= -grown) & (corners.min(axis=1) <= np.array(window.shape) * BRICK + grown)
    wanted = (areas > 0) & inside.all(axis=1)
    corners, normals = corners[wanted], normals[wanted] / areas[wanted, None]
    # The axis that a triangle faces comes last; turning all three keeps them right-handed.
    axes = (np.abs(normals).argmax(axis=1)[:, None] + [1, 2, 0]) % 3
    corners = np.take_along_axis(corners, axes[:, None, :], axis=2)
    normals = np.take_along_axis(normals, axes, axis=1)
    # Counted from a voxel of its own, a triangle keeps its digits in float32.
    origins = np.floor(corners.min(axis=1)).astype(np.int32)
    shapes = np.concatenate([corners - origins[:, None], normals[:, None]], axis=1).astype(np.float32)
    sizes = np.take_along_axis(np.broadcast_to(np.array(window.shape) * BRICK, axes.shape), axes, axis=1)
    first = np.floor(shapes[:, :3, 1].min(axis=1) - grown).astype(np.int32)
    last = np.floor(shapes[:, :3, 1].max(axis=1) + grown).astype(np.int32)
    first, last = np.maximum(first, -origins[:, 1]), np.minimum(last, sizes[:, 1] - 1 - origins[:, 1])
    counts = np.maximum(last - first + 1, 0)
    if counts.sum() == 0:
        return
    triangles = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    begins = np.cumsum(counts) - counts
    rows = np.arange(len(triangles)) - np.repeat(begins - first, counts)
    _mark_rows(
        triangles, rows.astype(np.int32), np.ascontiguousarray(shapes),
        origins.ravel(), axes[:, 2].astype(np.int32), window.shape_vector, grown, marks,
    )  # fmt: skip
    runtime.settle()


@ti.func
def _overlap(p: Vec3, q: Vec3, facing: F32, x: F32, y: F32, size: F32) -> I32:
    """True if a triangle with corners (p, q) and the square from (x, y) on overlap, where their bounding
    boxes do. ``facing`` is the sense in which the corners follow each other."""
    sense = 1.0 if facing >= 0.0 else -1.0
    overlap = 1
    for i in ti.static(range(3)):
        # The square's corner that lies furthest to the inside of the edge still has to be inside.
        normal_p, normal_q = (q[i] - q[(i + 1) % 3]) * sense, (p[(i + 1) % 3] - p[i]) * sense
        inside = normal_p * (x - p[i]) + normal_q * (y - q[i])
        if inside + ti.max(0.0, normal_p * size) + ti.max(0.0, normal_q * size) < 0.0:
            overlap = 0
    return overlap


@ti.func
def _voxel_range(low: F32, high: F32, grown: F32, origin: I32, size: I32) -> Template:
    """First and last voxel, counted from the triangle's own, of an interval inside the window."""
    first = ti.max(ti.floor(low - grown, ti.i32), -origin)
    return ti.Vector([first, ti.min(ti.floor(high + grown, ti.i32), size - 1 - origin)])


@ti.kernel
def _mark_rows(
    triangles: I32Array, rows: I32Array, shapes: F32Array3, origins: I32Array, axes: I32Array,
    shape: IVec3, grown: F32, marks: I32Array,
):  # fmt: skip
    """For each row of each triangle: item i is row ``rows[i]`` of triangle ``triangles[i]`` (n). Along the
    axes a, b, c of a triangle it has the corners of ``shapes`` [triangle, 0:3] and the normal [triangle, 3];
    the voxel that they are counted from is in ``origins`` [3 * triangle], the axis that c is in ``axes`` (T).
    ``marks`` are those of a window of ``shape`` bricks."""
    for item in range(triangles.shape[0]):
        t, j = triangles[item], rows[item]
        a = Vec3(shapes[t, 0, 0], shapes[t, 1, 0], shapes[t, 2, 0])
        b = Vec3(shapes[t, 0, 1], shapes[t, 1, 1], shapes[t, 2, 1])
        c = Vec3(shapes[t, 0, 2], shapes[t, 1, 2], shapes[t, 2, 2])
        normal = Vec3(shapes[t, 3, 0], shapes[t, 3, 1], shapes[t, 3, 2])
        origin = IVec3(origins[3 * t], origins[3 * t + 1], origins[3 * t + 2])
        axis_c = axes[t]
        size_a, size_c = shape[0] * BRICK, shape[0] * BRICK
        if axis_c == 0:
            size_a = shape[1] * BRICK
        elif axis_c == 1:
            size_a, size_c = shape[2] * BRICK, shape[1] * BRICK
        else:
            size_c = shape[2] * BRICK
        slope_a, slope_b = -normal[0] / normal[2], -normal[1] / normal[2]
        size = 1.0 + 2.0 * grown
        reach = 0.5 * size * (ti.abs(slope_a) + ti.abs(slope_b))
        y = j - grown
        columns = _voxel_range(a.min(), a.max(), grown, origin[0], size_a)
        for i in range(columns[0], columns[1] + 1):
            x = i - grown
            if _overlap(a, b, normal[2], x, y, size):
                plane = c[0] + slope_a * (i + 0.5 - a[0]) + slope_b * (j + 0.5 - b[0])
                low, high = ti.max(plane - reach, c.min()), ti.min(plane + reach, c.max())
                depths = _voxel_range(low, high, grown, origin[2], size_c)
                for k in range(depths[0], depths[1] + 1):
                    z = k - grown
                    if _overlap(b, c, normal[0], y, z, size) and _overlap(c, a, normal[1], z, x, size):
                        local = origin + IVec3(i, j, k)
                        cell = IVec3(local[0], local[1], local[2])
                        if axis_c == 0:
                            cell = IVec3(local[2], local[0], local[1])
                        elif axis_c == 1:
                            cell = IVec3(local[1], local[2], local[0])
                        if within(cell, shape * BRICK):
                            mark(marks, voxel_in_window(cell, shape))
