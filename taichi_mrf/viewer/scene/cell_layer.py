"""The cells that stand in for voxels, in the scene: points of 2, 4 or 8 times a voxel's size, a cloud for
each side in each chunk.

They follow from the page's copy of the map, so the mapping process has no part in them. While the map
changes, computing them takes a small share of the time; once it is at rest, all are brought up to date.
"""

import math
import time
from dataclasses import dataclass
from functools import cache

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import LOG_ODDS_STEP, pack_log_odds
from taichi_mrf.viewer.scene.coloring import probabilities, voxel_colors
from taichi_mrf.viewer.scene.voxel_layer import Look
from taichi_mrf.viewer.scene.voxel_store import Chunk, ChunkKey, Shown, VoxelStore, facing
from taichi_mrf.voxels.cells import SIDES, SUREST, lowest_voxels, standing_in, voxels_of_cells
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS

AT_ONCE_S, WHILE_CHANGING_S = 0.1, 0.03
"""Cells are computed for so long, in seconds, before events are handled: at rest, and while the map
changes."""

SHARE_OF_TIME = 0.1
"""While the map changes, computing cells takes at most this share of the time."""

NodeKey = tuple[ChunkKey, int]
"""A chunk, and the side of the cells in voxels."""


@dataclass(frozen=True)
class _Points:
    """What clients have of the cells of one side in a chunk: ``centres`` (n, 3) in voxels from the centre of
    the chunk's first voxel, ``colors`` (n, 3)."""

    centres: NDArray[np.float16]
    colors: NDArray[np.uint8]
    point_size: float

    def same_as(self, other: "_Points | None") -> bool:
        return (
            other is not None
            and self.point_size == other.point_size
            and np.array_equal(self.centres, other.centres)
            and np.array_equal(self.colors, other.colors)
        )


class CellLayer:
    """Owns the scene nodes under ``prefix``."""

    def __init__(
        self,
        scene: viser.SceneApi,
        prefix: str,
        voxel_size: float,
        prior_log_odds: float,
        min_evidence: float,
    ) -> None:
        """``min_evidence`` in log-odds: voxels that are not so much likelier than the prior do not count."""
        self._scene, self._prefix, self._voxel_size = scene, prefix, voxel_size
        self._evidence = prior_log_odds + min_evidence
        self._stale: dict[ChunkKey, None] = {}  # the oldest first
        self._due = -math.inf
        self._sent: dict[NodeKey, _Points] = {}
        self._prepared: dict[NodeKey, _Points | None] = {}
        self._nodes: dict[NodeKey, viser.PointCloudHandle] = {}

    @property
    def shown(self) -> int:
        """Number of cells that clients show once everything prepared has been sent."""
        ahead: dict[NodeKey, _Points | None] = {**self._sent, **self._prepared}
        return sum(len(points.colors) for points in ahead.values() if points is not None)

    def due(self, at_rest_s: float) -> float | None:
        """The monotonic time at which :meth:`prepare` should be called, None if it has nothing to do; the map
        is at rest from ``at_rest_s`` on."""
        return min(self._due, at_rest_s) if self._stale else None

    def outdate(self, chunks: set[ChunkKey]) -> None:
        """Note that some chunks look different."""
        self._stale |= dict.fromkeys(sorted(chunks))

    def prepare(self, store: VoxelStore, look: Look, seconds: float) -> None:
        """Compute the cells of chunks that have changed, for at most about so long; :meth:`send` sends
        them."""
        begin = time.monotonic()
        for key in list(self._stale):
            del self._stale[key]
            chunk = store.chunks.get(key) if look.cells else None
            found = {} if chunk is None else self._points(key, chunk, look)
            for side in SIDES:
                points, before = found.get(side), self._sent.get((key, side))
                if points is not None and not points.same_as(before):
                    self._prepared[key, side] = points
                elif points is None and before is not None:
                    self._prepared[key, side] = None
            if time.monotonic() - begin > seconds:
                break
        now = time.monotonic()
        self._due = now + (now - begin) / SHARE_OF_TIME

    def send(self) -> None:
        """Send what was prepared."""
        for node, points in self._prepared.items():
            if points is None:
                self._nodes.pop(node).remove()
                del self._sent[node]
            else:
                self._send(node, points)
        self._prepared.clear()

    def clear(self) -> None:
        """Remove everything from the scene."""
        self._stale.clear()
        self._prepared = dict.fromkeys(self._sent)
        self.send()

    def boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres (n, 3) and sides (n,) of all cells that are shown, in metres, in the world."""
        centres, sides = [np.zeros((0, 3))], [np.zeros(0)]
        for (key, side), sent in self._sent.items():
            centres.append(sent.centres.astype(np.float64) * self._voxel_size + self._position(key))
            sides.append(np.full(len(sent.colors), side * self._voxel_size))
        return np.concatenate(centres), np.concatenate(sides)

    def _points(self, key: ChunkKey, chunk: Chunk, look: Look) -> dict[int, _Points]:
        """The cells of a chunk that are to be seen, by side."""
        cut, (axis, sign) = look.cut, look.up
        found = {}
        for side, shown in standing_cells(chunk, look.log_odds, self._evidence):
            if cut is not None:
                last = shown.cells[:, cut.axis].astype(np.int32) + key[cut.axis] * CHUNK_VOXELS + side - 1
                shown = shown.kept(last <= cut.voxel)
            if len(shown.cells):
                centres = shown.cells + 0.5 * (side - 1)
                heights_m = sign * (key[axis] * CHUNK_VOXELS + 0.5 + centres[:, axis]) * self._voxel_size
                faces = facing(shown.cells // side, CHUNK_VOXELS // side) if look.shade else None
                colors = voxel_colors(look.scale, shown, heights_m, faces)
                found[side] = _Points(centres.astype(np.float16), colors, side * look.point_size)
        return found

    def _send(self, node: NodeKey, points: _Points) -> None:
        key, side = node
        self._nodes[node] = self._scene.add_point_cloud(
            f"{self._prefix}/{key[0]}_{key[1]}_{key[2]}_{side}",
            points=points.centres,
            colors=points.colors,
            point_size=points.point_size,
            point_shape="square",
            precision="float16",
            scale=self._voxel_size,
            position=self._position(key),
        )
        self._sent[node] = points

    def _position(self, key: ChunkKey) -> NDArray[np.float64]:
        """Position of the centre of the chunk's first voxel, in metres, world."""
        return (np.array(key) * CHUNK_VOXELS + 0.5) * self._voxel_size


def standing_cells(chunk: Chunk, threshold: float, evidence: float) -> list[tuple[int, Shown]]:
    """The cells of a chunk that stand in for voxels where none has the log-odds ``threshold``, by side:
    ``Shown.cells`` are their lowest voxels, the other values those of the cells. Voxels of more than
    ``evidence`` log-odds have evidence of a surface."""
    steps = int(np.floor(evidence / LOG_ODDS_STEP))
    rows = np.flatnonzero((chunk.log_odds > steps).any(axis=1))
    log_odds, corners = chunk.log_odds[rows], chunk.bricks[rows] * BRICK
    marginals = _marginals()[log_odds.view(np.uint16)]
    found = []
    for side, standing, likely in standing_in(marginals, log_odds > steps, 1 / (1 + math.exp(-threshold))):
        row, cell = np.nonzero(standing)
        p = np.minimum(likely[row, cell].astype(np.float64), SUREST)
        voxels = rows[row][:, None], voxels_of_cells(side)[cell]
        colors = None if chunk.colors is None else _mean_colors(chunk.colors[voxels])
        lowest = (corners[row] + lowest_voxels(side)[cell]).astype(np.uint8)
        seen = chunk.seen[voxels].max(axis=1)
        found.append((side, Shown(lowest, pack_log_odds(np.log(p / (1 - p))), seen, colors)))
    return found


@cache
def _marginals() -> NDArray[np.float32]:
    return probabilities().astype(np.float32)


def _mean_colors(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The mean of the colours that were seen in each cell, (n, voxels, 3) -> (n, 3)."""
    known = (colors != NO_COLOR).any(axis=2)
    sums = (colors * known[..., None]).sum(axis=1, dtype=np.int64)
    count = known.sum(axis=1)[:, None]
    return np.where(count > 0, sums // np.maximum(count, 1), NO_COLOR).astype(np.uint8)
