"""A window: the box of bricks that one keyframe or one view looks at, as a dense index.

Kernels that follow rays do not query the topology: the bricks that they need are scattered into a
small dense array first, which is faster to read, the same on every backend, and needs no compilation
for each map. The window's corner is also the origin of the rays' coordinates, worked out in float64
on the host, so that float32 is exact enough anywhere in the world.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.resident import Resident
from taichi_mrf.system.types import I32, I32Array, IVec3
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_BRICKS
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import Space, Viewpoint

LARGEST_CHUNK = 2**31 // CHUNK
"""Bricks further out than this, in chunks, have no int32 coordinates."""

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Window:
    """A box of bricks, aligned to chunks: its lowest brick in the world and its size in bricks."""

    lowest: tuple[int, int, int]
    shape: tuple[int, int, int]
    voxel_size: float

    @staticmethod
    def covering(lower_m: ArrayLike, upper_m: ArrayLike, voxel_size: float) -> "Window":
        """The smallest window around a box in metres. Raises CapacityError if it would not fit memory."""
        chunk_m = voxel_size * BRICK * CHUNK
        first = np.floor(np.asarray(lower_m, np.float64) / chunk_m)
        last = np.floor(np.asarray(upper_m, np.float64) / chunk_m)
        if max(-first.min(), last.max() + 1) > LARGEST_CHUNK:
            reach = LARGEST_CHUNK * chunk_m
            raise CapacityError(
                f"a place further than {reach:.3g} m from the world's origin is out of reach at a voxel size "
                f"of {voxel_size:g} m"
            )
        shape = (last - first + 1) * CHUNK
        # Three int32 for each brick: the footprint's mark, the cells that it finds, and the index.
        check_memory(12.0 * float(np.prod(shape)), f"a view at a voxel size of {voxel_size:g} m")
        lowest = first.astype(np.int64) * CHUNK
        return Window(
            (int(lowest[0]), int(lowest[1]), int(lowest[2])),
            (int(shape[0]), int(shape[1]), int(shape[2])),
            voxel_size,
        )

    @property
    def cells(self) -> int:
        """Number of bricks in the box."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def bricks_of(self, cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """(n,) numbers of cells in the window -> (n, 3) brick coordinates in the world."""
        return (np.stack(np.unravel_index(cells, self.shape), axis=1) + self.lowest).astype(np.int32)

    def cells_of(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]:
        """(n, 3) brick coordinates -> (n,) numbers of cells, -1 outside the window."""
        local = bricks - np.asarray(self.lowest)
        inside = ((local >= 0) & (local < self.shape)).all(axis=1)
        cells = np.full(len(bricks), -1, np.int32)
        cells[inside] = np.ravel_multi_index(tuple(local[inside].T), self.shape)
        return cells

    def to_voxels(self, points_m: ArrayLike) -> Vector:
        """World points in metres -> voxels from the window's corner."""
        return np.asarray(points_m, np.float64) / self.voxel_size - np.asarray(self.lowest) * BRICK

    def viewpoint(self, T_world_camera: Pose) -> Viewpoint:
        """The camera in the window, as kernels take it."""
        return Viewpoint(
            ti.Vector(self.to_voxels(T_world_camera[:3, 3]).tolist(), ti.f32),
            ti.Matrix((T_world_camera[:3, :3] / self.voxel_size).tolist(), ti.f32),
        )

    def clip_box(self, lower_m: ArrayLike | None, upper_m: ArrayLike | None) -> tuple[ti.Vector, ti.Vector]:
        """The part of the window that may hold voxels, as two corners in voxels."""
        lower, upper = np.zeros(3), np.asarray(self.shape, np.float64) * BRICK
        if lower_m is not None and upper_m is not None:
            lower = np.maximum(lower, np.round(self.to_voxels(lower_m)))
            upper = np.minimum(upper, np.round(self.to_voxels(upper_m)))
        return ti.Vector(lower.tolist(), ti.f32), ti.Vector(upper.tolist(), ti.f32)

    @property
    def shape_vector(self) -> ti.Vector:
        """The size in bricks as a kernel argument."""
        return ti.Vector(list(self.shape), ti.i32)


class WindowIndex:
    """The dense index itself: one for all windows, filled before use and emptied after it."""

    def __init__(self) -> None:
        self._reset(1)

    def _reset(self, cells: int) -> None:
        runtime.settle()
        self.bricks = ti.ndarray(ti.i32, cells)
        self.bricks.fill(-1)
        self.chunks = ti.ndarray(ti.i32, max(1, cells // CHUNK_BRICKS))

    def fill(self, window: Window, cells: Resident, slots: Resident) -> None:
        """Enter bricks: ``slots[i]`` at cell ``cells[i]`` of the window. NumPy or Taichi arrays (n); there
        may be more slots than cells."""
        if window.cells > self.bricks.shape[0]:
            self._reset(window.cells)
        _enter(window.shape_vector, cells, slots, self.bricks, self.chunks)

    def clear(self, window: Window, cells: Resident) -> None:
        """Remove the same bricks, which costs less than clearing the whole index."""
        _take_out(window.shape_vector, cells, self.bricks, self.chunks)

    def space(
        self, window: Window, lower_m: ArrayLike | None = None, upper_m: ArrayLike | None = None
    ) -> Space:
        """The bricks that are filled in, as rays meet them. Two corners in metres bound the mapped volume."""
        lower, upper = window.clip_box(lower_m, upper_m)
        return Space(window.shape_vector, lower, upper, self.chunks, self.bricks)


@ti.kernel
def _enter(shape: IVec3, cells: I32Array, slots: I32Array, bricks: I32Array, chunks: I32Array):
    """Write slot ``slots[i]`` at cell ``cells[i]``; there may be more slots than cells. ``bricks`` and
    ``chunks`` are those of traversal.Space, ``shape`` is the window's in bricks."""
    for i in range(cells.shape[0]):
        bricks[cells[i]] = slots[i]
        chunks[_chunk_of(cells[i], shape)] = 1


@ti.kernel
def _take_out(shape: IVec3, cells: I32Array, bricks: I32Array, chunks: I32Array):
    """Undo :func:`_enter` for the same cells."""
    for i in range(cells.shape[0]):
        bricks[cells[i]] = -1
        chunks[_chunk_of(cells[i], shape)] = 0


@ti.func
def _chunk_of(cell: I32, shape: IVec3) -> I32:
    """The number of the chunk that holds a window's cell."""
    brick = IVec3(cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2])
    return flat(brick // CHUNK, shape // CHUNK)
