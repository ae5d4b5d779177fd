"""Kernels of the distance field: how far each voxel is from the nearest obstacle.

The squared distance to the nearest obstacle splits into one minimum for each axis,

    d^2(x, y, z) = min over x' of (x - x')^2 + min over y' of (y - y')^2 + min over z' of (z - z')^2,

taken over the obstacles at (x', y', z') (Felzenszwalb & Huttenlocher, Theory of Computing 8, 2012).
Distances are cut off, so each minimum runs over a bounded stretch of a line, and a change reaches no further
than that. All of it is in whole voxels: a field that was updated equals one that is made anew, bit for bit,
on every backend.

A voxel that is no obstacle has the squared distance to the nearest obstacle, an obstacle that to the nearest
other voxel, negative. In both sums the voxels of the other kind have the distance 0, so one number serves for
both.
"""

from taichi_mrf.queries.distance_grid import (
    ALL_BITS,
    COLUMNS,
    FAR,
    FLIPPED_BITS,
    KEPT_BITS,
    SAMPLES,
    SIDE,
    UNKNOWN_BITS,
    FieldGrid,
)
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, IVec3, IVec8, Template
from taichi_mrf.voxels.layout import BRICK, VOXELS


@kernel
def along_z(cells: I32Array, grid: FieldGrid, first: I32Array, changed: I32Array) -> None:
    """Squared distances along z alone for the voxels of some bricks, numbers (n) in the window, into
    ``first`` (slots * 512); ``changed`` (n) becomes 1 for bricks in which any differs from what was there."""
    for part in range(cells.shape[0] * COLUMNS):
        row, number = part // COLUMNS, part % COLUMNS
        cell = grid.cell(cells[row])
        own = grid.column(cell, number) & ALL_BITS
        beyond = grid.reach + 1
        # From the brick's lowest and highest voxel to the nearest of each kind before and after the brick.
        free_before, full_before = _nearest(grid, cell, number, -1)
        free_after, full_after = _nearest(grid, cell, number, 1)
        near = ti.Vector.zero(ti.i32, BRICK)
        for k in ti.static(range(BRICK)):
            is_full = (own >> k) & 1
            free_before = ti.select(is_full == 1, free_before + 1, 0)
            full_before = ti.select(is_full == 1, 0, full_before + 1)
            near[k] = ti.max(free_before, full_before)
        for step in ti.static(range(BRICK)):
            k = BRICK - 1 - step
            is_full = (own >> k) & 1
            free_after = ti.select(is_full == 1, free_after + 1, 0)
            full_after = ti.select(is_full == 1, 0, full_after + 1)
            nearest = ti.min(near[k], ti.max(free_after, full_after), beyond)
            value = nearest * nearest * (1 - 2 * is_full)
            place = grid.slot(cell) * VOXELS + number * BRICK + k
            if first[place] != value:
                first[place] = value
                changed[row] = 1


@ti.func
def _nearest(grid: Template, cell: IVec3, number: I32, way: I32):
    """From the layer of voxels beside a brick, below it (``way`` -1) or above (1), to the nearest voxel that
    is no obstacle and to the nearest obstacle in a column, in voxels; ``reach`` or more where there is
    none."""
    free, full = grid.reach, grid.reach
    column = 0
    k = 0
    while k < grid.reach and (free == grid.reach or full == grid.reach):
        if k % BRICK == 0:
            column = grid.column(cell + IVec3(0, 0, way * (1 + k // BRICK)), number)
        bit = k % BRICK
        if way < 0:
            bit = BRICK - 1 - bit
        if (column >> bit) & 1 == 1:
            full = ti.min(full, k)
        else:
            free = ti.min(free, k)
        k += 1
    return free, full


@kernel
def along_y(cells: I32Array, grid: FieldGrid, first: I32Array, second: I32Array, changed: I32Array) -> None:
    """Squared distances in planes of equal x from those along z, ``first``, into ``second`` (slots * 512
    each); ``cells`` and ``changed`` as in :func:`along_z`."""
    for part in range(cells.shape[0] * COLUMNS):
        row, number = part // COLUMNS, part % COLUMNS
        cell = grid.cell(cells[row])
        place = grid.slot(cell) * VOXELS + number * BRICK
        found = _least(grid, first, cell, number, 1)
        for k in ti.static(range(BRICK)):
            if second[place + k] != found[k]:
                second[place + k] = found[k]
                changed[row] = 1


@kernel
def along_x(
    cells: I32Array, grid: FieldGrid, second: I32Array, metres: F32Array, values: F32Array,
    changed: I32Array, counts: I32Array,
) -> None:  # fmt: skip
    """Distances in metres from squared ones in planes of equal x, ``second`` (slots * 512), for the bricks'
    own voxels into ``values`` (slots * 729). ``metres`` ((reach + 1)^2 + 1) has the distance of each square.

    ``counts`` (n) counts the voxels of each brick of ``cells`` (n) that have another distance than before, or
    have one now, or none any more. ``changed`` (n) becomes 1 where any number does, known or not.
    """
    for part in range(cells.shape[0] * COLUMNS):
        row, number = part // COLUMNS, part % COLUMNS
        cell = grid.cell(cells[row])
        slot = grid.slot(cell)
        found = _least(grid, second, cell, number, 0)
        column = grid.classes[slot * COLUMNS + number]
        flipped, unknown = column >> FLIPPED_BITS, column >> UNKNOWN_BITS
        grid.classes[slot * COLUMNS + number] = column & KEPT_BITS
        moved, counted = 0, 0
        for k in ti.static(range(BRICK)):
            value = metres[ti.abs(found[k])]
            if found[k] < 0:
                value = -value
            place = slot * SAMPLES + (number // BRICK * SIDE + number % BRICK) * SIDE + k
            if values[place] != value or (flipped >> k) & 1 == 1:
                moved = 1
                if (flipped >> k) & 1 == 1 or (unknown >> k) & 1 == 0:
                    counted += 1
            values[place] = value
        if moved == 1:
            changed[row] = 1
            counts[row] += counted


@kernel
def join_bricks(
    cells: I32Array,
    grid: FieldGrid,
    values: F32Array,
    far_m: F32,
    outside_m: F32,
    far: I32Array,
    outside: I32Array,
) -> None:
    """Copy to bricks, numbers (n) in the window, the first layers of those after them, in ``values`` (slots *
    729).

    ``far_m`` and ``outside_m`` are the distances in FAR and OUTSIDE bricks; ``far`` (n) and ``outside`` (n)
    count the distances of each brick that are such, in space that is known and in space that is like OUTSIDE
    bricks.
    """
    for part in range(cells.shape[0] * SIDE * SIDE):
        row, i, j = part // (SIDE * SIDE), part // SIDE % SIDE, part % SIDE
        cell = grid.cell(cells[row])
        own = grid.slot(cell) * SAMPLES + (i * SIDE + j) * SIDE
        in_far, in_outside = 0, 0
        for step in range(2):
            there = cell + IVec3(i // BRICK, j // BRICK, step)
            slot = grid.slot(there)
            column = grid.column(there, i % BRICK * BRICK + j % BRICK)
            source = slot * SAMPLES + (i % BRICK * SIDE + j % BRICK) * SIDE
            for k in range(step * BRICK, BRICK + step):
                value = outside_m
                if slot >= 0:
                    value = values[source + k % BRICK]
                elif slot == FAR:
                    value = far_m
                values[own + k] = value
                unknown = (column >> (k % BRICK + UNKNOWN_BITS)) & 1
                if value == far_m and unknown == 0:
                    in_far += 1
                if value == outside_m and unknown == (grid.outside_class >> UNKNOWN_BITS) & 1:
                    in_outside += 1
        far[row] += in_far
        outside[row] += in_outside


@ti.func
def _least(grid: Template, sums: Template, cell: IVec3, number: I32, axis: Template) -> IVec8:
    """For each voxel of a column of a brick, the least of the squared distance along an axis, x or y, and the
    rest of it, ``sums`` (slots * 512), with the sign of the voxel's own kind."""
    own = grid.column_of(sums, cell, number)
    sign = ti.select(own < 0, IVec8(-1), IVec8(1))
    least = ti.abs(own)
    here = number % BRICK if ti.static(axis == 1) else number // BRICK
    k = 1
    while k <= grid.reach and k * k < least.max():
        for way in ti.static((-1, 1)):
            there = here + way * k
            if ti.static(axis == 1):
                beside = grid.column_of(sums, cell + IVec3(0, there >> 3, 0), number - here + (there & 7))
                least = ti.min(least, k * k + ti.max(sign * beside, 0))
            else:
                beside = grid.column_of(
                    sums, cell + IVec3(there >> 3, 0, 0), number % BRICK + (there & 7) * BRICK
                )
                least = ti.min(least, k * k + ti.max(sign * beside, 0))
        k += 1
    return sign * least
