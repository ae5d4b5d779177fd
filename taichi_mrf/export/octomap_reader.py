"""Reads OctoMap's files into bricks of voxels.

A leaf of OctoMap stands for a cube of any size. Here each voxel of the cube gets its own log-odds, which
needs far more memory than the file: the size is checked before any memory is allocated.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.export.octomap import (
    BINARY_HEADER,
    BRICK_LEVEL,
    DEPTH,
    FULL_HEADER,
    INNER,
    NO_CHILD,
    OCCUPIED_LEAF,
    bricks_of_codes,
    voxels_in_z_order,
)
from taichi_mrf.queries.known_bricks import Bricks
from taichi_mrf.system.files import read_bytes
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import VOXELS

FREE_PROBABILITY, OCCUPIED_PROBABILITY = 0.1192, 0.971
"""Probabilities of the leaves of a ``.bt``: the limits at which OctoMap clamps."""

_NODE_BYTES = {"OcTree": 5, "ColorOcTree": 8}
"""Bytes of a node in an ``.ot``, by the kind of tree: value, colour if any, children."""

_BYTES_PER_VOXEL = 10
"""At the peak: the log-odds, the same in another order, and the numbers of the voxels."""


@dataclass(frozen=True)
class OctomapLeaves:
    """The leaves of a tree: ``code`` (n,) int64 and ``level`` (n,) int8 as in octree.Nodes, ``log_odds`` (n,)
    float32; ``voxel_size`` in metres; ``source`` the file."""

    code: NDArray[np.int64]
    level: NDArray[np.int8]
    log_odds: NDArray[np.float32]
    voxel_size: float
    source: str

    @property
    def voxels(self) -> int:
        """Number of voxels that the leaves stand for."""
        return int((8 ** self.level.astype(np.int64)).sum())

    def bricks(self) -> tuple[Bricks, NDArray[np.float32]]:
        """Bricks (n, 3) and their log-odds (n, 512), 0 where nothing is known.

        Raises CapacityError if they do not fit memory.
        """
        small = self.level < BRICK_LEVEL
        partly = np.unique(self.code[small] >> 3 * BRICK_LEVEL)
        whole_level = self.level[~small].astype(np.int64) - BRICK_LEVEL
        count = len(partly) + int((8**whole_level).sum())
        what = f"{count * VOXELS / 1e6:.3g} million voxels, in {len(self.code):,} OctoMap leaves,"
        check_memory(float(count) * VOXELS * _BYTES_PER_VOXEL, f"{self.source}: {what}")
        values = np.zeros((count, VOXELS), np.float32)
        for level in range(BRICK_LEVEL):
            rows = np.flatnonzero(self.level == level)
            codes = self.code[rows, None] + np.arange(8**level)
            place = np.searchsorted(partly, codes >> 3 * BRICK_LEVEL)
            values[place, codes & (VOXELS - 1)] = self.log_odds[rows, None]
        whole = [
            code + np.arange(8**level)
            for code, level in zip((self.code[~small] >> 3 * BRICK_LEVEL).tolist(), whole_level, strict=True)
        ]
        values[len(partly) :] = np.repeat(self.log_odds[~small], 8**whole_level)[:, None]
        in_order = np.empty_like(values)
        in_order[:, voxels_in_z_order()] = values
        keys = np.concatenate([partly, *whole])
        return bricks_of_codes(keys << 3 * BRICK_LEVEL), in_order


def read_octomap(path: str | Path) -> OctomapLeaves:
    """Read a ``.bt`` or ``.ot``, told apart by the first line. Raises MapFileError, which names the file."""
    content = read_bytes(path, MapFileError)
    header, data = _split(path, content)
    binary = header["#"] == BINARY_HEADER
    try:
        voxel_size, size = float(header["res"]), int(header["size"])
    except (KeyError, ValueError) as error:
        raise MapFileError(f"{path}: its header lacks a resolution or a size") from error
    if not 0 < voxel_size < np.inf:
        raise MapFileError(f"{path}: a resolution of {voxel_size} m is not valid")
    kind = header.get("id", "OcTree")
    if not binary and kind not in _NODE_BYTES:
        raise MapFileError(f"{path}: unsupported kind of tree {kind[:40]}; supported are {_KINDS}")
    try:
        if size == 0:
            leaves: _Leaves = 0, [], [], np.zeros(0, np.float32)
        elif binary:
            leaves = _binary_leaves(data)
        else:
            leaves = _full_leaves(data, _NODE_BYTES[kind])
    except IndexError as error:
        raise MapFileError(f"{path}: damaged: its nodes do not form a tree, or end too early") from error
    nodes, codes, levels, values = leaves
    if nodes != size:  # which OctoMap's own reader refuses too
        raise MapFileError(f"{path}: damaged: it has {nodes:,} nodes, but {size:,} by its header")
    if not np.isfinite(values).all():
        raise MapFileError(f"{path}: damaged: a node's value is not finite")
    return OctomapLeaves(np.array(codes, np.int64), np.array(levels, np.int8), values, voxel_size, str(path))


_KINDS = ", ".join(_NODE_BYTES)
_Leaves = tuple[int, list[int], list[int], NDArray[np.float32]]
"""Number of nodes, inner ones included; the leaves' codes, levels and log-odds."""

_BITS = [[child for child in range(7, -1, -1) if mask >> child & 1] for mask in range(256)]
"""The children in a mask, the last one first: they are put on a stack."""


def _split(path: str | Path, content: bytes) -> tuple[dict[str, str], bytes]:
    """The header's words, its first line under "#", and what follows it."""
    match = re.search(rb"^data[ \t\r]*\n", content[:65536], re.MULTILINE)
    first = content.partition(b"\n")[0].decode("ascii", "replace").strip()
    if not first.startswith((FULL_HEADER, BINARY_HEADER)) or match is None:
        raise MapFileError(f"{path}: not an OctoMap file (.bt or .ot)")
    header = {"#": BINARY_HEADER if first.startswith(BINARY_HEADER) else FULL_HEADER}
    for line in content[: match.start()].decode("ascii", "replace").splitlines():
        word, _, value = line.partition(" ")
        if not line.startswith("#") and value:
            header[word] = value.strip()
    return header, content[match.end() :]


def _full_leaves(data: bytes, node_bytes: int) -> _Leaves:
    """Raises IndexError if the nodes do not form a tree."""
    count = len(data) // node_bytes
    table = np.frombuffer(data, np.uint8, count * node_bytes).reshape(count, node_bytes)
    rows, codes, levels, nodes = [], [], [], 0
    stack = [(0, DEPTH)]
    for row, mask in enumerate(table[:, -1].tobytes()):
        if not stack:
            break  # a line's end after the last node
        code, level = stack.pop()
        nodes += 1
        if mask == 0:
            rows.append(row)
            codes.append(code)
            levels.append(level)
            continue
        below = _below(level)
        stack += [(code | child << 3 * below, below) for child in _BITS[mask]]
    if stack:
        raise IndexError
    values = np.ascontiguousarray(table[rows, :4]).view("<f4").reshape(-1).astype(np.float32)
    return nodes, codes, levels, values


def _binary_leaves(data: bytes) -> _Leaves:
    """Raises IndexError if the nodes do not form a tree."""
    words = iter(np.frombuffer(data, "<u2", len(data) // 2).tolist())
    codes, levels, occupied, inner = [], [], [], 0
    stack = [(0, DEPTH)]
    while stack:
        code, level = stack.pop()
        inner += 1
        word = next(words, None)
        if word is None:
            raise IndexError
        below = _below(level)
        for child in range(7, -1, -1):
            kind = word >> 2 * child & 3
            if kind == NO_CHILD:
                continue
            child_code = code | child << 3 * below
            if kind == INNER:
                stack.append((child_code, below))
            else:
                codes.append(child_code)
                levels.append(below)
                occupied.append(kind == OCCUPIED_LEAF)
    limits = np.array([FREE_PROBABILITY, OCCUPIED_PROBABILITY])
    log_odds = np.log(limits / (1 - limits)).astype(np.float32)
    return inner + len(codes), codes, levels, log_odds[np.array(occupied, np.int64)]


def _below(level: int) -> int:
    if level == 0:
        raise IndexError
    return level - 1
