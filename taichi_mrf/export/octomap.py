"""Maps as OctoMap's files: ``.ot`` with the log-odds, and colours if there are any, ``.bt`` with free and
occupied voxels.

The format is that of OctoMap's AbstractOcTree::write and OccupancyOcTreeBase::writeBinary: a header in text,
then the nodes in pre-order. In an ``.ot`` each has a float32, in a ColorOcTree red, green and blue, and a bit
for each child; in a ``.bt`` only the inner ones are written, with two bits for each child.
"""

from pathlib import Path

import numpy as np

from taichi_mrf.export.octree import Nodes, channels, octree_of
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.atomic import atomic_path

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
    _write(path, FULL_HEADER, nodes, m.voxel_size, records.tobytes(), kind)


def write_bt(path: str | Path, m: VoxelMap, cells: bool = False) -> None:
    """Write which voxels are free and which occupied, the rest being unknown; ``cells`` as in
    :func:`write_ot`. Raises MapFileError, CapacityError."""
    nodes = octree_of(m, only_state=True, cells=cells)
    inner = nodes.kinds[nodes.children != 0].astype("<u2")
    _write(path, BINARY_HEADER, nodes, m.voxel_size, inner.tobytes())


def _write(
    path: str | Path, first_line: str, nodes: Nodes, voxel_size: float, data: bytes, kind: str = "OcTree"
) -> None:
    header = (
        f"{first_line}\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id {kind}\nsize {len(nodes)}\nres {voxel_size:.9g}\ndata\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + data)
