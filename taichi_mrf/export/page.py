"""A map as one HTML file that any browser opens, without this program and without a network.

The file holds the scene of the live page, made by the same classes, as viser serializes it.
"""

import math
from functools import cache
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.geometry.up import Z_UP, Up
from taichi_mrf.queries.colored import shown_colors_in
from taichi_mrf.queries.known_bricks import BrickReader
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.atomic import write_text
from taichi_mrf.viewer.messages import LOG_ODDS_STEP, pack_log_odds
from taichi_mrf.viewer.scene.coloring import probabilities
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.viewpoint import ViewpointController
from taichi_mrf.viewer.scene.voxel_layer import Look, VoxelLayer, look_of
from taichi_mrf.viewer.scene.voxel_store import Chunk, Shown, VoxelStore, facing
from taichi_mrf.viewer.transport.downloads import standalone_page
from taichi_mrf.viewer.transport.server import start_server
from taichi_mrf.voxels.cells import SUREST, lowest_voxels, standing_in, voxels_of_cells
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layers import COLORS, LOG_ODDS
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS

_NOT_SHOWN = np.float32(-60)
"""Log-odds below any threshold."""


def write_page(
    path: str | Path,
    m: VoxelMap,
    threshold: float = 0.5,
    up: Up | None = None,
    colored: VoxelMap | None = None,
    cells: bool = False,
) -> None:
    """Write a page that shows the voxels of at least this probability, ``up`` pointing up (default: the
    map's), by their marginals or in the colours of ``colored``, the same map; with ``cells`` also the cells
    that stand in for voxels (queries/cells.py). Raises MapFileError, ViewerError."""
    server = start_server("127.0.0.1", 0, Path(path).stem)
    try:
        layer = VoxelLayer(server.scene, "/voxels", m.voxel_size)
        reader = BrickReader(m)
        prior, min_evidence = reader.pool.prior_log_odds, m.view.volume.min_evidence
        for bricks, log_odds, _ in reader.batches(reader.bricks):
            # Some maps give unseen voxels a probability of one half; those must not be shown.
            seen = np.where(log_odds == prior, _NOT_SHOWN, log_odds)
            layer.store.put(bricks, log_odds=pack_log_odds(seen))
            if colored is not None:
                layer.store.put(bricks, colors=shown_colors_in(colored, reader.slots(bricks)))
        eye = ViewpointController(server)
        eye.set_up(up or m.up or Z_UP)
        bounds = layer.store.bounds()
        if bounds is not None:
            by = "marginal probability" if colored is None else "photo"
            options = ViewOptions(color_by=by, threshold=threshold)
            look = look_of(options, layer.store, eye.up, m.voxel_size)
            layer.prepare(look, everything=True, exactly=True)
            layer.send()
            if cells:
                add_cells(server.scene, layer.store, look, m.voxel_size, prior + min_evidence)
            low, high = (end.astype(np.float64) * BRICK * m.voxel_size for end in (bounds[0], bounds[1] + 1))
            eye.map_grew(low, high)
        write_text(path, standalone_page(server.get_scene_serializer()))
    finally:
        server.stop()


def add_cells(
    scene: viser.SceneApi, store: VoxelStore, look: Look, voxel_size: float, evidence: float
) -> None:
    """Add the cells of a map, below /cells. Voxels of at most ``evidence`` log-odds do not count."""
    for key, chunk in store.chunks.items():
        first_m = (np.array(key) * CHUNK_VOXELS + 0.5) * voxel_size  # the centre of the first voxel
        for side, shown in standing_cells(chunk, look.log_odds, evidence):
            if not len(shown.cells):
                continue
            centres = shown.cells + 0.5 * (side - 1)
            faces = facing(shown.cells // side, CHUNK_VOXELS // side)
            scene.add_point_cloud(
                f"/cells/{key[0]}_{key[1]}_{key[2]}_{side}",
                points=centres.astype(np.float16),
                colors=look.paint(shown, (voxel_size * centres + first_m).astype(np.float32), faces),
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
    rows = np.flatnonzero((chunk.values[LOG_ODDS] > steps).any(axis=1))
    log_odds, corners = chunk.values[LOG_ODDS][rows], chunk.bricks[rows] * BRICK
    marginals = _marginals()[log_odds.view(np.uint16)]
    found = []
    for side, standing, likely in standing_in(marginals, log_odds > steps, 1 / (1 + math.exp(-threshold))):
        row, cell = np.nonzero(standing)
        p = np.minimum(likely[row, cell].astype(np.float64), SUREST)
        voxels = rows[row][:, None], voxels_of_cells(side)[cell]
        colors = _mean_colors(chunk.values[COLORS][voxels]) if COLORS in chunk.values else None
        lowest = (corners[row] + lowest_voxels(side)[cell]).astype(np.uint8)
        seen = chunk.values["seen"][voxels].max(axis=1)
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
