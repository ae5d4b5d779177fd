"""The factor graph of all beams (section III-C), and the workers that share them: cells that each beam
crosses, and beams that cross each cell.

Two compressed lists. That of a beam holds its cells in their order from the origin; it is found with the
traversal that all rays use, in a pass that counts and one that writes. That of a cell holds its beams, and at
which step each of them comes through; only some methods need it, so it is made when it is first used. A beam
is the factor of its number; an edge is a place in the beams' list.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.factor_graph.beams import Beams, BrickCells, Grid
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import available_bytes
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array2, I32Array, IVec3, Struct, Template, Vec3
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import advance, enter, leave_at, make_ray, within


@ti.dataclass
class _Cursor(Struct):
    """Place at which a beam's next cell is written."""

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
    """Write the number of cells that each beam crosses to ``counts`` (beams).

    ``rays`` is (beams, 7): origin, direction and range in cell sizes from the corner of a grid of ``shape``
    cells.
    """
    for beam in range(counts.shape[0]):
        place = _Cursor(0)
        walk_cells(rays, beam, shape, _count, place, counts)
        counts[beam] = place.next


@ti.kernel
def write_cells(rays: F32Array2, shape: IVec3, begins: I32Array, cells: I32Array):
    """Write the cells that each beam crosses to ``cells`` (edges), from ``begins`` (beams + 1) on; ``rays``
    as above."""
    for beam in range(begins.shape[0] - 1):
        place = _Cursor(begins[beam])
        walk_cells(rays, beam, shape, _write, place, cells)


@ti.kernel
def count_degrees(cells: I32Array, edges: ti.i32, degrees: I32Array):
    """Count the beams that cross each cell: ``cells`` (edges) into ``degrees`` (cells)."""
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


EDGE_BYTES = 4 + 6 + 4
"""A cell's number; a beam's number and step in the cell's list; a message."""

BEAM_BYTES = 4 + 4 + 28 + 3 * 4
"""Bytes of a beam: the start of its cells, whether it hit, its geometry; what a method keeps of it."""

CELL_BYTES = 4 + 4 + 4 * 8
"""Its degree, where its beams begin; what a method keeps of it."""

MOST_EDGES = 2**31 - 1
"""Taichi numbers an array's elements with 32 bits."""


@dataclass(frozen=True)
class CellLists(Bundle):
    """For each cell the beams that cross it: those of cell i are ``begins[i]`` to ``begins[i + 1]``."""

    begins: I32Array
    """(cells + 1)."""

    beams: I32Array
    """(edges)."""

    steps: AnyArray
    """(edges) int16: the place of the cell among the beam's cells."""


@dataclass(frozen=True)
class FactorGraph:
    """Cells, beams and the edges between them."""

    grid: Grid | BrickCells
    beams: int
    edges: int
    longest: int
    """Most cells of any beam."""

    begins: ti.Ndarray
    """(beams + 1,) int32: the cells of beam f are ``cells[begins[f]]`` to ``cells[begins[f + 1] - 1]``."""

    cells: ti.Ndarray
    """(edges,) int32."""

    hits: ti.Ndarray
    """(beams,) int32: 1 where something returned."""

    model: ti.Ndarray
    """Sensor model of each beam: (beams, 7) float32, its origin, direction and range in cell sizes from the
    grid's lowest corner; or, with ``has_table``, (edges + beams, 1) float32, its energies."""

    degrees: ti.Ndarray
    """(cells,) int32: the beams that cross a cell; 0 for a disconnected one."""

    has_table: bool = False
    """True if ``model`` holds the energies themselves: of beam f, from ``begins[f] + f`` on, one for each of
    its cells to be the first occupied one, and one for none."""

    @cached_property
    def largest_energy(self) -> float:
        """Of the table, the largest absolute value; 0 without one."""
        return float(np.abs(self.model.to_numpy()).max()) if self.has_table else 0.0

    @cached_property
    def lists(self) -> CellLists:
        """The beams of each cell."""
        begins = np.zeros(self.grid.cells + 1, np.int32)
        np.cumsum(self.degrees.to_numpy(), out=begins[1:])
        lists = CellLists(
            _array(begins), ti.ndarray(ti.i32, max(1, self.edges)), ti.ndarray(ti.i16, max(1, self.edges))
        )
        write_beams_of_cells(self.begins, self.cells, begins[:-1].copy(), lists.beams, lists.steps)
        return lists

    @cached_property
    def connected(self) -> NDArray[np.bool_]:
        """(cells,) which cells any beam crosses."""
        return self.degrees.to_numpy() > 0

    @property
    def nbytes(self) -> int:
        """Bytes of the graph with the lists of both sides, and of what one method keeps beside it."""
        return needed_bytes(self.beams, self.edges, self.grid.cells, self.has_table)


def needed_bytes(beams: int, edges: int, cells: int, has_table: bool = False) -> int:
    """Bytes of a graph of that size, and of what one method keeps beside it."""
    table = 4 * (edges + beams) if has_table else 0
    return BEAM_BYTES * beams + EDGE_BYTES * edges + CELL_BYTES * cells + table


def build_graph(beams: Beams, cell_size: float, memory_limit_gb: float = 0.0) -> FactorGraph:
    """Find the cells that each beam crosses (eq. 10), from its origin to its end.

    ``memory_limit_gb`` of 0 means nine tenths of what the machine has free. Raises CapacityError, which names
    the memory that the graph would take, before it is taken.
    """
    grid = Grid.around(beams, cell_size)
    check_capacity(len(beams), grid.cells, 0, memory_limit_gb)
    rays = np.zeros((max(1, len(beams)), 7), np.float32)
    rays[: len(beams), :3] = grid.to_cells(beams.origins)
    rays[: len(beams), 3:6] = beams.directions
    rays[: len(beams), 6] = beams.range_m / cell_size
    begins = np.zeros(len(beams) + 1, np.int64)
    shape = ti.Vector(grid.shape, ti.i32)
    ray_array = _array(rays)
    counts = np.zeros(len(beams), np.int32)
    if len(beams):
        count_cells(ray_array, shape, counts)
    np.cumsum(counts, out=begins[1:])
    edges = int(begins[-1])
    check_capacity(len(beams), grid.cells, edges, memory_limit_gb)
    begin_array = _array(begins.astype(np.int32))
    cells, degrees = ti.ndarray(ti.i32, max(1, edges)), ti.ndarray(ti.i32, grid.cells)
    if len(beams):
        write_cells(ray_array, shape, begin_array, cells)
        count_degrees(cells, edges, degrees)
    hits = np.zeros(max(1, len(beams)), np.int32)
    hits[: len(beams)] = beams.hit
    longest = int(counts.max(initial=1))
    return FactorGraph(grid, len(beams), edges, longest, begin_array, cells, _array(hits), ray_array, degrees)


def check_capacity(
    beams: int, cells: int, edges: int, limit_gb: float, has_table: bool = False,
    advice: str = "choose a larger cell size or a smaller max_range",
) -> None:  # fmt: skip
    """Raise CapacityError if a graph of that size would not fit, or could not be numbered."""
    wanted = needed_bytes(beams, edges, cells, has_table)
    free = available_bytes()
    limit = limit_gb * 1e9 if limit_gb > 0 else (0.9 * free if free is not None else None)
    what = f"a factor graph of {beams:,} beams, {cells:,} cells and {edges:,} edges"
    if limit is not None and wanted > limit:
        raise CapacityError(
            f"{what} would need {wanted / 1e9:.3g} GB of memory, but only {limit / 1e9:.3g} GB are "
            f"available; {advice}"
        )
    if max(edges + beams, cells) > MOST_EDGES:
        raise CapacityError(
            f"{what} would need {wanted / 1e9:.3g} GB of memory and has more than 2^31 - 1 of them; {advice}"
        )


def _array(values: NDArray) -> ti.Ndarray:
    array = ti.ndarray(ti.i32 if values.dtype == np.int32 else ti.f32, values.shape)
    array.from_numpy(values)
    return array


SCRATCH_BYTES = 256 << 20
"""Most scratch on a GPU, of two values for each step of a worker's present beam."""


@dataclass(frozen=True)
class BeamWorkers(Bundle):
    """Workers that take a part of all beams each."""

    number: I32

    spread: I32
    """Iterations of the parallel loop that a worker stands for."""

    longest: I32
    """Steps of the longest beam: a worker's part of the scratch."""

    @ti.func
    def begin(self, worker: I32, first: I32, end: I32):
        """Start of a worker's part of first .. end; it ends where the next worker's starts."""
        return first + ti.cast(ti.cast(end - first, ti.i64) * worker // self.number, ti.i32)


def beam_workers(graph: FactorGraph) -> BeamWorkers:
    """Workers for the backend that runs."""
    if runtime.active() == "cpu":
        # Taichi gives a CPU thread no fewer than 512 iterations of a loop at a time.
        return BeamWorkers(64, 512, graph.longest)
    most = SCRATCH_BYTES // (8 * graph.longest)
    return BeamWorkers(max(256, min(65536, most, graph.beams)), 1, graph.longest)
