"""Maps as OctoMap's files: ``.ot`` with the log-odds, and colours if there are any, ``.bt`` with free and
occupied voxels.

The format is that of OctoMap's AbstractOcTree::write and OccupancyOcTreeBase::writeBinary: a header in text,
then the nodes in pre-order. In an ``.ot`` each has a float32, in a ColorOcTree red, green and blue, and a bit
for each child; in a ``.bt`` only the inner ones are written, with two bits for each child.

The nodes stand in arrays, level by level. A leaf is a voxel, or a cube of 8^level voxels that all hold the
same. Voxels are numbered along a Z-order curve: the bits of x, y and z, counted from the octree's corner,
taken in turn. All voxels of a node follow each other in that order, and a node's number is that of its first
voxel. Source: Hornung et al., OctoMap (2013), and the layout of its class OcTree.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import CapacityError
from taichi_mrf.queries.cells import SUREST, standing_in
from taichi_mrf.queries.known_bricks import BrickReader, Bricks, seen_free_bricks
from taichi_mrf.queries.points import OCCUPIED, UNKNOWN
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick

DEPTH = 16
"""Levels between the root and a voxel, in every tree of OctoMap's."""

HALF_SPAN = 1 << (DEPTH - 1)
"""Voxels from the world's origin to each end of the octree."""

BRICK_LEVEL = 3
"""A brick of 8^3 voxels is a node of this level."""

NO_CHILD, FREE_LEAF, OCCUPIED_LEAF, INNER = 0, 1, 2, 3
"""The kinds of a child, in two bits of OctoMap's binary format."""

WHITE = np.uint32(0xFFFFFF)
"""The colour that OctoMap takes for none."""

_CHILDREN = 8

_BYTES_PER_NODE = 68
"""Peak memory of sorting the nodes: twice their arrays, and their numbers."""


@dataclass(frozen=True)
class Nodes:
    """Nodes in one level, or in pre-order (parents first, children by number).

    ``code`` (n,) int64 is the number of the first voxel in the node, ``level`` (n,) int8 its level, 0 for a
    voxel; ``value`` (n,) float32 log-odds, for an inner node the largest below it; ``children`` (n,) uint8
    has a bit for each child, 0 for a leaf; ``kinds`` (n,) uint16 two bits for each, see :data:`NO_CHILD`;
    ``color`` (n,) uint32 is red + 256 green + 65536 blue, :data:`WHITE` for none, for an inner node the
    mean of its children's.
    """

    code: NDArray[np.int64]
    level: NDArray[np.int8]
    value: NDArray[np.float32]
    children: NDArray[np.uint8]
    kinds: NDArray[np.uint16]
    color: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.code)

    def __getitem__(self, rows: NDArray) -> "Nodes":
        return Nodes(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @staticmethod
    def leaves(
        code: NDArray[np.int64],
        level: int,
        value: NDArray[np.float32],
        color: NDArray[np.uint32] | None = None,
    ) -> "Nodes":
        """Leaves of one level, without a colour if ``color`` is None."""
        n = len(code)
        return Nodes(
            code, np.full(n, level, np.int8), value.astype(np.float32), np.zeros(n, np.uint8),
            np.zeros(n, np.uint16), np.full(n, WHITE) if color is None else color,
        )  # fmt: skip

    @staticmethod
    def concatenate(parts: list["Nodes"]) -> "Nodes":
        """All nodes of some lists, which must not be empty."""
        return Nodes(*(np.concatenate([getattr(p, n) for p in parts]) for n in Nodes.__dataclass_fields__))


def octree_of(
    m: VoxelMap, *, only_state: bool, colored: VoxelMap | None = None, cells: bool = False
) -> Nodes:
    """The known space of a map in pre-order: no node for unknown space, leaves for free space, with or
    without voxels in the map, and for what is occupied. Eight equal leaves are one.

    With ``only_state`` all free voxels are equal, at -1, and all occupied ones, at +1. Occupied voxels get
    the colours of ``colored``, the same map. With ``cells``, a cell of 2, 4 or 8 voxels that is more likely
    occupied than not, although none of its voxels is, is one occupied leaf without a colour
    (queries.cells.standing_cells). Raises CapacityError if the map is larger than an octree of
    OctoMap's, or if there is not enough memory.
    """
    reader = BrickReader(m)
    done: list[Nodes] = []
    with_voxels = reader.bricks
    order = np.argsort(brick_codes(with_voxels))
    tops = []
    for bricks, log_odds, state in reader.batches(with_voxels[order]):
        values = np.where(state == OCCUPIED, np.float32(1), np.float32(-1)) if only_state else log_odds
        first, shown = brick_codes(bricks), state[:, _IN_Z_ORDER] != UNKNOWN
        standing = _standing_leaves(reader, first, log_odds, shown, only_state) if cells else []
        row, place = np.nonzero(shown)
        color = None
        if colored is not None:
            seen = colored.colors_in(reader.slots(bricks))[:, _IN_Z_ORDER][row, place]
            painted = (state[:, _IN_Z_ORDER][row, place] == OCCUPIED) & (seen[:, 3] > 0)
            color = np.where(painted, _packed(seen), WHITE)
        nodes = Nodes.leaves(first[row] + place, 0, values[:, _IN_Z_ORDER][row, place], color)
        for leaves in standing:
            joined = Nodes.concatenate([_joined_up_to(int(leaves.level[0]), nodes, done), leaves])
            nodes = joined[np.argsort(joined.code)]
        tops.append(_joined_up_to(BRICK_LEVEL, nodes, done))
    free = seen_free_bricks(m)
    if len(free):
        value = np.full(len(free), -1.0) if only_state else reader.log_odds(free)[:, 0]
        tops.append(Nodes.leaves(brick_codes(free), BRICK_LEVEL, value))
    if not tops:
        return Nodes.leaves(np.zeros(0, np.int64), 0, np.zeros(0, np.float32))
    level = Nodes.concatenate(tops)
    done.append(_joined_up_to(DEPTH, level[np.argsort(level.code)], done))
    count = sum(len(part) for part in done)
    check_memory(_BYTES_PER_NODE * count, f"an octree of {count / 1e6:.3g} million nodes")
    nodes = Nodes.concatenate(done)
    return nodes[np.argsort(nodes.code * 32 + (DEPTH - nodes.level))]


def _standing_leaves(
    reader: BrickReader,
    first: NDArray[np.int64],
    log_odds: NDArray[np.float32],
    shown: NDArray[np.bool_],
    only_state: bool,
) -> list[Nodes]:
    """The cells of some bricks that stand in for voxels, as leaves by level, the lowest first. ``first`` (n,)
    are the bricks' codes; their voxels, in the order of the curve, are taken out of ``shown`` (n, 512)."""
    found = []
    for side, standing, likely in standing_in(reader, log_odds, 0.5):
        level, across = side.bit_length() - 1, BRICK // side
        # Rows of cells in the order of the curve, each of which holds 8^level voxels that follow each other.
        in_z_order = np.argsort(z_order(np.indices((across,) * 3).reshape(3, -1).T.astype(np.int64)))
        row, cell = np.nonzero(standing[:, in_z_order])
        if len(row):
            shown.reshape(len(first), -1, side**3)[row, cell] = False
            p = np.clip(likely[:, in_z_order][row, cell].astype(np.float64), 0.5, SUREST)
            value = np.where(only_state, 1.0, np.log(p / (1 - p))).astype(np.float32)
            found.append(Nodes.leaves(first[row] + (cell.astype(np.int64) << 3 * level), level, value))
    return found


def brick_codes(bricks: Bricks) -> NDArray[np.int64]:
    """Number of the first voxel of each brick, (n, 3) -> (n,). Raises CapacityError outside the octree."""
    corner = bricks.astype(np.int64) * BRICK + HALF_SPAN
    if len(corner) and (corner.min() < 0 or corner.max() >= 2 * HALF_SPAN):
        raise CapacityError(f"the map reaches further than OctoMap's {HALF_SPAN} voxels from the origin")
    return z_order(corner)


def bricks_of_codes(codes: NDArray[np.int64]) -> Bricks:
    """The brick that each voxel lies in, (n,) -> (n, 3)."""
    corner = np.stack([_gathered(codes >> axis) for axis in range(3)], axis=1)
    return ((corner - HALF_SPAN) // BRICK).astype(np.int32)


def z_order(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells (n, 3), 0 to 65535 along each axis -> their numbers along the curve; x has the lowest bit."""
    return sum(_spread(cells[:, axis]) << axis for axis in range(3))  # type: ignore[return-value]


def _spread(x: NDArray[np.int64]) -> NDArray[np.int64]:
    """The 16 lowest bits, two zeros between each."""
    for shift, mask in _SPREADING:
        x = (x | x << shift) & mask
    return x


def _gathered(x: NDArray[np.int64]) -> NDArray[np.int64]:
    """Every third bit, the inverse of :func:`_spread`."""
    x = x & _SPREADING[-1][1]
    for (shift, _), mask in zip(
        reversed(_SPREADING), [*(m for _, m in _SPREADING[-2::-1]), 0xFFFF], strict=True
    ):
        x = (x | x >> shift) & mask
    return x


_SPREADING = (
    (16, 0x00FF0000FF),
    (8, 0x00F00F00F00F),
    (4, 0x0C30C30C30C3),
    (2, 0x249249249249),
)
"""Shifts and masks that spread 16 bits over 48."""

_IN_Z_ORDER = np.argsort(z_order(offsets_in_brick().astype(np.int64)))
"""The voxels of a brick by their numbers in it, in the order of the curve."""


def voxels_in_z_order() -> NDArray[np.int64]:
    """(512,) numbers in a brick of its voxels, in the order of the curve."""
    return _IN_Z_ORDER


def channels(color: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Red, green and blue (n, 3) of the colours of nodes (n,)."""
    return (color[:, None] >> np.array([0, 8, 16], np.uint32)).astype(np.uint8)


def _packed(color: NDArray[np.uint8]) -> NDArray[np.uint32]:
    wide = color.astype(np.uint32)
    return wide[:, 0] | wide[:, 1] << np.uint32(8) | wide[:, 2] << np.uint32(16)


def _mean_colors(color: NDArray[np.uint32], first: NDArray[np.intp]) -> NDArray[np.uint32]:
    """The mean colour of the children from each of ``first`` on, rounded down as OctoMap does; those without
    a colour do not count."""
    has = color != WHITE
    count = np.add.reduceat(has.astype(np.uint32), first)
    sums = np.add.reduceat(np.where(has[:, None], channels(color), np.uint8(0)).astype(np.uint32), first)
    return np.where(count > 0, _packed(sums // np.maximum(count, 1)[:, None]), WHITE)


def _joined_up_to(level: int, nodes: Nodes, done: list[Nodes]) -> Nodes:
    """The nodes of ``level`` over some nodes of one level below it, ascending; those below go to ``done``."""
    while len(nodes) and nodes.level[0] < level:
        nodes = _parents(nodes, done)
    return nodes


def _parents(nodes: Nodes, done: list[Nodes]) -> Nodes:
    """The next level up. Eight equal leaves become one; all other nodes are done."""
    level = int(nodes.level[0]) + 1
    key = nodes.code >> 3 * level
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    count = np.diff(np.append(first, len(key)))
    child = (nodes.code >> 3 * (level - 1)) & (_CHILDREN - 1)
    leaf = nodes.children == 0
    kind = np.where(leaf, np.where(nodes.value >= 0, OCCUPIED_LEAF, FREE_LEAF), INNER).astype(np.uint16)
    largest = np.maximum.reduceat(nodes.value, first)
    equal = np.minimum.reduceat(nodes.value, first) == largest
    color = np.full(len(first), WHITE)
    if (nodes.color != WHITE).any():
        equal &= np.minimum.reduceat(nodes.color, first) == np.maximum.reduceat(nodes.color, first)
        color = _mean_colors(nodes.color, first)
    joined = (count == _CHILDREN) & equal & np.logical_and.reduceat(leaf, first)
    done.append(nodes[~np.repeat(joined, count)])
    children = np.bitwise_or.reduceat((1 << child).astype(np.uint8), first)
    kinds = np.bitwise_or.reduceat(kind << (2 * child).astype(np.uint16), first)
    return Nodes(
        key[first] << 3 * level,
        np.full(len(first), level, np.int8),
        largest,
        np.where(joined, np.uint8(0), children),
        np.where(joined, np.uint16(0), kinds),
        color,
    )


FULL_HEADER, BINARY_HEADER = "# Octomap OcTree file", "# Octomap OcTree binary file"
"""First lines that identify OctoMap files."""

FULL_NODE = np.dtype([("value", "<f4"), ("children", "u1")])
"""A node of an ``.ot``."""

COLOR_NODE = np.dtype([("value", "<f4"), ("color", "u1", 3), ("children", "u1")])
"""A node of an ``.ot`` of the kind ColorOcTree."""


def write_ot(path: str | Path, m: VoxelMap, colored: VoxelMap | None = None, cells: bool = False) -> None:
    """Write a map with its log-odds, as a ColorOcTree with the colours of ``colored``, the same map; unknown
    stays unknown. With ``cells``, larger leaves stand in for voxels none of which is likely occupied
    (octree.octree_of). Raises MapFileError, CapacityError."""
    nodes = octree_of(m, only_state=False, colored=colored, cells=cells)
    records = np.empty(len(nodes), FULL_NODE if colored is None else COLOR_NODE)
    records["value"], records["children"] = nodes.value, nodes.children
    if colored is not None:
        records["color"] = channels(nodes.color)
    kind = "OcTree" if colored is None else "ColorOcTree"
    _write(path, FULL_HEADER, len(nodes), m.voxel_size, records.tobytes(), kind)


def write_bt(path: str | Path, m: VoxelMap, cells: bool = False) -> None:
    """Write which voxels are free and which occupied, the rest being unknown; ``cells`` as in
    :func:`write_ot`. Raises MapFileError, CapacityError."""
    data, size = binary_octree(m, cells)
    _write(path, BINARY_HEADER, size, m.voxel_size, data)


def binary_octree(m: VoxelMap, cells: bool = False) -> tuple[bytes, int]:
    """The nodes of a ``.bt``, as octomap_msgs/Octomap has them too, and their number. Raises
    CapacityError."""
    nodes = octree_of(m, only_state=True, cells=cells)
    return nodes.kinds[nodes.children != 0].astype("<u2").tobytes(), len(nodes)


def _write(
    path: str | Path, first_line: str, size: int, voxel_size: float, data: bytes, kind: str = "OcTree"
) -> None:
    header = (
        f"{first_line}\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id {kind}\nsize {size}\nres {voxel_size:.9g}\ndata\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + data)
