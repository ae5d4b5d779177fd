"""The cells that stand in for voxels, in the scene of an exported page: points of 2, 4 or 8 times a voxel's
size, a cloud for each side in each chunk."""

import math
from functools import cache

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import LOG_ODDS_STEP, pack_log_odds
from taichi_mrf.viewer.scene.coloring import probabilities, voxel_colors
from taichi_mrf.viewer.scene.voxel_layer import Look
from taichi_mrf.viewer.scene.voxel_store import Chunk, Shown, VoxelStore, facing
from taichi_mrf.voxels.cells import SUREST, lowest_voxels, standing_in, voxels_of_cells
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS


def add_cells(
    scene: viser.SceneApi, store: VoxelStore, look: Look, voxel_size: float, evidence: float
) -> None:
    """Add the cells of a map, below /cells. Voxels of at most ``evidence`` log-odds do not count."""
    axis, sign = look.up
    for key, chunk in store.chunks.items():
        first_m = (np.array(key) * CHUNK_VOXELS + 0.5) * voxel_size  # the centre of the first voxel
        for side, shown in standing_cells(chunk, look.log_odds, evidence):
            if not len(shown.cells):
                continue
            centres = shown.cells + 0.5 * (side - 1)
            heights_m = sign * (first_m[axis] + centres[:, axis] * voxel_size)
            faces = facing(shown.cells // side, CHUNK_VOXELS // side) if look.shade else None
            scene.add_point_cloud(
                f"/cells/{key[0]}_{key[1]}_{key[2]}_{side}",
                points=centres.astype(np.float16),
                colors=voxel_colors(look.scale, shown, heights_m, faces),
                point_size=side * look.point_size,
                point_shape="square",
                precision="float16",
                scale=voxel_size,
                position=first_m,
            )


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
