"""The kernels that build a factor graph: follow each beam through the box of cells, count, then write."""

from taichi_mrf.kernels.types import F32, AnyArray, F32Array2, I32Array, IVec3, Struct, Template, Vec3
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import advance, enter, leave_at, make_ray, within


@ti.dataclass
class _Cursor(Struct):
    """Where a beam's next cell is written."""

    next: ti.i32


@ti.func
def walk_cells(
    rays: Template, beam: ti.i32, shape: IVec3, visit: Template, state: Template, context: Template
):
    """Call ``visit(state, context, cell)`` with the number of each cell that a beam crosses, in order."""
    ray = make_ray(
        Vec3(rays[beam, 0], rays[beam, 1], rays[beam, 2]), Vec3(rays[beam, 3], rays[beam, 4], rays[beam, 5])
    )
    end: F32 = rays[beam, 6]
    t = 0.0
    walk = enter(ray, t, 1, IVec3(0), shape)
    while t < end and within(walk.cell, shape):
        leave = leave_at(walk)
        t_leave = ti.min(leave, end)
        if t_leave > t:  # a ray through an edge touches cells for no length at all
            visit(state, context, flat(walk.cell, shape))
            t = t_leave
        advance(ray, walk, leave, 1)


@ti.func
def _count(state: Template, context: Template, cell: ti.i32):
    """One cell of a beam whose cells are counted."""
    state.next += 1


@ti.func
def _write(state: Template, context: Template, cell: ti.i32):
    """One cell of a beam."""
    context[state.next] = cell
    state.next += 1


@ti.kernel
def count_cells(rays: F32Array2, shape: IVec3, counts: I32Array):
    """How many cells each beam crosses, into ``counts`` (beams).

    ``rays`` is (beams, 7): origin, direction and range in cell sizes from the corner of a grid of ``shape``
    cells.
    """
    for beam in range(counts.shape[0]):
        place = _Cursor(0)
        walk_cells(rays, beam, shape, _count, place, counts)
        counts[beam] = place.next


@ti.kernel
def write_cells(rays: F32Array2, shape: IVec3, begins: I32Array, cells: I32Array):
    """Which cells each beam crosses, into ``cells`` (edges) from ``begins`` (beams + 1) on; ``rays`` as
    above."""
    for beam in range(begins.shape[0] - 1):
        place = _Cursor(begins[beam])
        walk_cells(rays, beam, shape, _write, place, cells)


@ti.kernel
def count_degrees(cells: I32Array, edges: ti.i32, degrees: I32Array):
    """How many beams cross each cell: ``cells`` (edges) counted into ``degrees`` (cells)."""
    for edge in range(edges):
        ti.atomic_add(degrees[cells[edge]], 1)


@ti.kernel
def write_beams_of_cells(
    begins: I32Array, cells: I32Array, places: I32Array, beams: I32Array, steps: AnyArray
):
    """Each cell's ``beams`` and their ``steps`` (edges); ``places`` (cells) is where each cell's list begins,
    and is used up. ``begins`` (beams + 1) and ``cells`` (edges) are those of the graph.

    The order within a cell's list depends on the threads: sums over it must not depend on it.
    """
    for beam in range(begins.shape[0] - 1):
        for edge in range(begins[beam], begins[beam + 1]):
            place = ti.atomic_add(places[cells[edge]], 1)
            beams[place] = beam
            steps[place] = ti.cast(edge - begins[beam], ti.i16)
