"""The factor graph of all beams (section III-C): which cells each beam crosses, and which beams cross a cell.

Two compressed lists. That of a beam holds its cells in their order from the origin; it is found with the
traversal that all rays use, in a pass that counts and one that writes. That of a cell holds its beams, and
at which step each of them comes through; only some methods need it, so it is made when it is first used. A
beam is the factor of its number; an edge is a place in the beams' list.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.factor_graph.beams import Beams, BrickCells, Grid
from taichi_mrf.factor_graph.kernels import count_cells, count_degrees, write_beams_of_cells, write_cells
from taichi_mrf.kernels.bundles import Bundle
from taichi_mrf.kernels.types import AnyArray, I32Array
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import available_bytes

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
    degrees.fill(0)
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
