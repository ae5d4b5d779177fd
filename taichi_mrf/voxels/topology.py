"""The bricks that exist: the map's index from brick coordinates to slots in the pool.

On CPU and CUDA it is a layer of a Taichi SNode tree, pointer -> pointer -> pointer -> bitmasked: a bitmasked
cell is a brick, the pointer cell above it a chunk of 8^3 bricks, the one above that a region of 32^3 chunks,
which together span 8192 bricks along each axis, and the uppermost a map. Vulkan has no sparse SNodes, so
there the same interface is served by dense arrays over a bounded volume. Code outside this file does not
depend on which of the two is used.

Beside its slot each brick has a number of crossings: how many keyframes' rays see most of it. A brick with
crossings and without a slot is free space; one with neither is unknown.
"""

import gc
import weakref
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F64, I32, AnyArray, AnyArray2, I32Array, IVec3, IVec4, Template
from taichi_mrf.voxels.layout import BRICK, CHUNK, VOXELS
from taichi_mrf.voxels.numbering import flat, voxel_number

Bricks = NDArray[np.int32]
"""(n, 3) brick coordinates in the world."""

UNSEEN, CROSSED = -1, -2
"""In place of a voxel that has no brick: one that no ray has crossed, and seen-free space."""

FARTHEST = 2.0**30
"""In voxels: points further away count as this far, which is beyond all maps."""


class Topology(Protocol):
    """The interface that both kinds of index serve. All arguments are NumPy arrays of one length."""

    def anchor(self, brick: Bricks) -> None:
        """Set where the map begins, (3,); a bounded index puts its volume around it, once."""

    def insert(self, bricks: Bricks, slots: NDArray[np.int32]) -> None:
        """Give bricks their slots; they must have passed :meth:`check`."""

    def erase(self, bricks: Bricks) -> None:
        """Remove bricks' slots."""

    def slots(self, bricks: Bricks) -> NDArray[np.int32]:
        """The slot of each brick, -1 where it does not exist."""

    def add_crossings(self, bricks: Bricks, number: int) -> None:
        """Count ``number`` (+1 or -1) keyframes more that see through each brick."""

    def crossings(self, bricks: Bricks) -> NDArray[np.int32]:
        """Number of keyframes that see through each brick."""

    def locate(self, points: Any, voxel_size: float, voxels: Any) -> None:
        """Write to ``voxels`` (N) int32 where in the pool the voxel of each of some points is, (N, 3) float32
        or float64 in metres and finite: slot * 512 + the voxel's number, CROSSED where rays pass and no brick
        is, else UNSEEN. The points are read where they are, also in a device's memory."""

    def check(self, bricks: Bricks, voxel_size: float) -> None:
        """Raise CapacityError, in metres, if any of the bricks lies outside the volume."""

    def drop_chunks(self, chunks: Bricks) -> None:
        """Give back the memory of chunks (n, 3) of bricks, none of which has a slot or is crossed."""

    def clear(self) -> None:
        """Forget everything."""


def create_topology(arch: str, dense_bricks: int) -> Topology:
    """An empty index for a backend; ``dense_bricks`` bounds it where it has to be dense. Raises CapacityError
    if the process has too many maps."""
    key = dense_bricks if arch == "vulkan" else 0
    if not _spare.get(key) and SparseTopology.all_taken():
        # maps may be unreachable but not collected: the traceback of an old exception holds its map
        gc.collect()
    if _spare.get(key):
        topology = _spare[key].pop()
        topology.clear()
        return topology
    return DenseTopology(dense_bricks) if arch == "vulkan" else SparseTopology()


def recycle(topology: Topology) -> None:
    """Keep the index of a map that is gone for the next map.

    A layer of the tree can be given away once only, and a dense index is large. It is cleared when it is
    taken again and not here: this runs when Python collects the map, where no kernel may be launched.
    """
    key = topology.side if isinstance(topology, DenseTopology) else 0
    _spare.setdefault(key, []).append(topology)


@ti.data_oriented
class _Tree:
    """The SNode tree: a layer for each map -> regions -> chunks -> bricks, which hold a slot and crossings.

    One tree for all maps of the process. Taichi compiles a kernel anew for each tree that it is used with,
    and a process with some ten trees of pointers crashes (Taichi 1.7.4).
    """

    # A node has memory for all of its cells, 16 bytes each, and CUDA has 1 GB for the tree: with layers of
    # 64^3 regions 190 maps filled it. An odd number of regions puts the world's origin in the middle of one.
    LAYERS, REGIONS, REGION = 256, 33, 32
    HALF_SPAN = (REGIONS - 1) * REGION * CHUNK // 2
    ORIGIN = REGIONS * REGION * CHUNK // 2

    def __init__(self) -> None:
        self.slot = ti.field(ti.i32)  # slot + 1, because an inactive cell reads as 0
        self.crossing = ti.field(ti.i32)
        builder = ti.FieldsBuilder()
        self.layers = builder.pointer(ti.l, self.LAYERS)
        self.regions = self.layers.pointer(ti.ijk, self.REGIONS)
        self.chunks = self.regions.pointer(ti.ijk, self.REGION)
        self.bricks = self.chunks.bitmasked(ti.ijk, CHUNK)
        self.bricks.place(self.slot, self.crossing)
        builder.finalize()
        self.unused = list(range(self.LAYERS))

    @ti.func
    def cell(self, bricks: Template, i: I32, layer: I32):
        """The cell of brick i of (n, 3) world coordinates in a layer of the tree."""
        return IVec4(
            bricks[i, 0] + self.ORIGIN, bricks[i, 1] + self.ORIGIN, bricks[i, 2] + self.ORIGIN, layer
        )

    @ti.func
    def in_span(self, cell: IVec4) -> I32:
        """True if a cell lies within the tree."""
        return ti.min(cell[0], cell[1], cell[2]) >= 0 and (
            ti.max(cell[0], cell[1], cell[2]) < 2 * self.ORIGIN
        )

    @ti.kernel
    def write(self, bricks: AnyArray, values: I32Array, layer: I32):
        """Set the slots of bricks (n, 3) of a layer to ``values`` (n), which are slots + 1; 0 takes them
        out."""
        for i in range(values.shape[0]):
            cell = self.cell(bricks, i, layer)
            # Writing a leaf activates its parents; ti.activate would not.
            self.slot[cell] = values[i]
            if values[i] == 0 and self.crossing[cell] == 0:
                ti.deactivate(self.bricks, cell)

    @ti.kernel
    def count(self, bricks: AnyArray, number: I32, layer: I32):
        """Add ``number`` to the crossings of bricks (n, 3) of a layer; each brick may occur once."""
        for i in range(bricks.shape[0]):
            cell = self.cell(bricks, i, layer)
            self.crossing[cell] += number
            if self.crossing[cell] == 0 and self.slot[cell] == 0:
                ti.deactivate(self.bricks, cell)

    @ti.kernel
    def read(self, bricks: AnyArray, out: I32Array, channel: I32, layer: I32):
        """Read slots + 1 (``channel`` 0) or crossings (1) of bricks (n, 3) of a layer into ``out`` (n)."""
        for i in range(out.shape[0]):
            cell = self.cell(bricks, i, layer)
            if self.in_span(cell):  # a query may ask for any point
                if channel == 0:
                    out[i] = self.slot[cell]
                else:
                    out[i] = self.crossing[cell]

    @ti.kernel
    def locate(self, points: AnyArray2, voxel_size: F64, voxels: I32Array, layer: I32):
        """Write the places in the pool of the voxels of points (N, 3) in metres into ``voxels`` (N), as
        Topology.locate has it."""
        for i in range(voxels.shape[0]):
            voxel = IVec3(0)
            for axis in ti.static(range(3)):
                place = ti.floor(ti.cast(points[i, axis], ti.f64) / voxel_size)
                voxel[axis] = ti.cast(ti.min(ti.max(place, -FARTHEST), FARTHEST), ti.i32)
            brick = (voxel >> 3) + self.ORIGIN
            cell = IVec4(brick[0], brick[1], brick[2], layer)
            found = UNSEEN
            if self.in_span(cell):
                slot = self.slot[cell] - 1
                if slot >= 0:
                    found = slot * VOXELS + voxel_number(voxel & 7)
                elif self.crossing[cell] > 0:
                    found = CROSSED
            voxels[i] = found

    @ti.kernel
    def drop_chunks(self, chunks: AnyArray, number: I32, layer: I32):
        """Deactivate ``number`` chunks (n, 3) of a layer."""
        for i in range(number):
            half = self.ORIGIN // CHUNK
            chunk = IVec4(chunks[i, 0] + half, chunks[i, 1] + half, chunks[i, 2] + half, layer)
            if ti.is_active(self.chunks, chunk):
                ti.deactivate(self.chunks, chunk)

    def clear(self, layer: int) -> None:
        """Empty a layer. Taichi does not give back what lies below a cell that is deactivated, so it is done
        from the bottom up."""
        self.clear_chunks(layer)
        self.clear_regions(layer)

    @ti.kernel
    def clear_chunks(self, layer: I32):
        """Deactivate all chunks of a layer."""
        for i, j, k in ti.ndrange(self.REGIONS, self.REGIONS, self.REGIONS):
            if ti.is_active(self.regions, [i, j, k, layer]):
                for di, dj, dk in ti.ndrange(self.REGION, self.REGION, self.REGION):
                    chunk = IVec4(i * self.REGION + di, j * self.REGION + dj, k * self.REGION + dk, layer)
                    if ti.is_active(self.chunks, chunk):
                        ti.deactivate(self.chunks, chunk)

    @ti.kernel
    def clear_regions(self, layer: I32):
        """Deactivate all regions of a layer, whose chunks are gone."""
        for i, j, k in ti.ndrange(self.REGIONS, self.REGIONS, self.REGIONS):
            if ti.is_active(self.regions, [i, j, k, layer]):
                ti.deactivate(self.regions, [i, j, k, layer])


class SparseTopology:
    """A layer of the SNode tree."""

    HALF_SPAN = _Tree.HALF_SPAN
    tree: ClassVar["_Tree | None"] = None

    def __init__(self) -> None:
        """Raises CapacityError if the process has too many maps."""
        if SparseTopology.tree is None:
            SparseTopology.tree = _Tree()
        if not SparseTopology.tree.unused:
            raise CapacityError(f"there are {_Tree.LAYERS} maps already, the most that a process can have")
        self._tree = SparseTopology.tree
        self.layer = self._tree.unused.pop()
        weakref.finalize(self, self._tree.unused.append, self.layer)
        self.clear()  # the map that used the layer before left its bricks in it

    @classmethod
    def all_taken(cls) -> bool:
        """True if no layer is left for another map."""
        return cls.tree is not None and not cls.tree.unused

    def anchor(self, brick: Bricks) -> None:
        """A sparse index spans the same space wherever the map begins."""

    def insert(self, bricks: Bricks, slots: NDArray[np.int32]) -> None:
        self._tree.write(bricks, slots + 1, self.layer)

    def erase(self, bricks: Bricks) -> None:
        self._tree.write(bricks, np.zeros(len(bricks), np.int32), self.layer)

    def slots(self, bricks: Bricks) -> NDArray[np.int32]:
        out = np.zeros(len(bricks), np.int32)
        self._tree.read(bricks, out, 0, self.layer)
        return out - 1

    def add_crossings(self, bricks: Bricks, number: int) -> None:
        self._tree.count(bricks, number, self.layer)

    def crossings(self, bricks: Bricks) -> NDArray[np.int32]:
        out = np.zeros(len(bricks), np.int32)
        self._tree.read(bricks, out, 1, self.layer)
        return out

    def locate(self, points: Any, voxel_size: float, voxels: Any) -> None:
        self._tree.locate(points, voxel_size, voxels, self.layer)

    def check(self, bricks: Bricks, voxel_size: float) -> None:
        if len(bricks) and max(-int(bricks.min()), int(bricks.max()) + 1) > self.HALF_SPAN:
            reach = self.HALF_SPAN * BRICK * voxel_size
            raise CapacityError(
                f"the map would reach further than {reach:g} m from the world's origin, which is the limit "
                f"at a voxel size of {voxel_size:g} m"
            )

    def drop_chunks(self, chunks: Bricks) -> None:
        self._tree.drop_chunks(np.ascontiguousarray(chunks, np.int32), len(chunks), self.layer)

    def clear(self) -> None:
        self._tree.clear(self.layer)


_spare: dict[int, list[Topology]] = {}
"""Indices without a map, by the side of a dense one, 0 for sparse ones."""


class DenseTopology:
    """Dense arrays of slots and crossings over a cube of bricks around the place where the map begins."""

    def __init__(self, side: int) -> None:
        self.side = side
        self.lowest: Bricks | None = None
        self.slot = ti.ndarray(ti.i32, side**3)
        self.crossing = ti.ndarray(ti.i32, side**3)
        self.clear()

    def anchor(self, brick: Bricks) -> None:
        if self.lowest is None:
            centre_chunk = np.asarray(brick, np.int32) // CHUNK * CHUNK
            self.lowest = (centre_chunk - self.side // 2).astype(np.int32)

    def insert(self, bricks: Bricks, slots: NDArray[np.int32]) -> None:
        _dense_write(self.slot, self._local(bricks), slots + 1, self.side, 0)

    def erase(self, bricks: Bricks) -> None:
        _dense_write(self.slot, self._local(bricks), np.zeros(len(bricks), np.int32), self.side, 0)

    def slots(self, bricks: Bricks) -> NDArray[np.int32]:
        out = np.zeros(len(bricks), np.int32)
        _dense_read(self.slot, self._local(bricks), out, self.side)
        return out - 1

    def add_crossings(self, bricks: Bricks, number: int) -> None:
        _dense_write(self.crossing, self._local(bricks), np.full(len(bricks), number, np.int32), self.side, 1)

    def crossings(self, bricks: Bricks) -> NDArray[np.int32]:
        out = np.zeros(len(bricks), np.int32)
        _dense_read(self.crossing, self._local(bricks), out, self.side)
        return out

    def locate(self, points: Any, voxel_size: float, voxels: Any) -> None:
        """On the host: the devices that need this index may lack float64."""
        places = np.floor(np.divide(points, voxel_size, dtype=np.float64))
        there = np.clip(places, -FARTHEST, FARTHEST).astype(np.int32)
        bricks = there // BRICK
        slots, local = self.slots(bricks), there - bricks * BRICK
        numbers = (local[:, 0] * BRICK + local[:, 1]) * BRICK + local[:, 2]
        without = np.where(self.crossings(bricks) > 0, CROSSED, UNSEEN)
        voxels[:] = np.where(slots >= 0, slots * VOXELS + numbers, without)

    def check(self, bricks: Bricks, voxel_size: float) -> None:
        local = self._local(bricks)
        if len(local) and (local.min() < 0 or local.max() >= self.side):
            extent = self.side * BRICK * voxel_size
            raise CapacityError(
                f"the map would leave its volume of {extent:g} m around the first keyframe, which is "
                f"bounded on Vulkan; use the CPU, or raise VolumeConfig.dense_bricks (now {self.side})"
            )

    def drop_chunks(self, chunks: Bricks) -> None:
        """The arrays are as large as the volume, whatever is in it."""

    def clear(self) -> None:
        self.slot.fill(0)
        self.crossing.fill(0)
        self.lowest = None

    def _local(self, bricks: Bricks) -> Bricks:
        lowest = self.lowest if self.lowest is not None else np.zeros(3, np.int32)
        return np.ascontiguousarray(bricks - lowest, np.int32)


@ti.kernel
def _dense_write(index: I32Array, bricks: AnyArray, values: I32Array, side: I32, add: I32):
    """Set the cells of bricks (n, 3), counted from the volume's corner, to ``values`` (n); with ``add`` 1,
    add them.

    ``index`` is (side^3), row by row. Bricks outside the volume are left out.
    """
    for i in range(values.shape[0]):
        cell = IVec3(bricks[i, 0], bricks[i, 1], bricks[i, 2])
        if cell.min() >= 0 and cell.max() < side:
            index[flat(cell, IVec3(side))] = values[i] + add * index[flat(cell, IVec3(side))]


@ti.kernel
def _dense_read(index: I32Array, bricks: AnyArray, out: I32Array, side: I32):
    """Read the cells of bricks (n, 3) from ``index`` (side^3) into ``out`` (n), 0 outside the volume."""
    for i in range(out.shape[0]):
        cell = IVec3(bricks[i, 0], bricks[i, 1], bricks[i, 2])
        found = 0
        if cell.min() >= 0 and cell.max() < side:
            found = index[flat(cell, IVec3(side))]
        out[i] = found  # always: on Vulkan what a kernel does not write comes back undefined
