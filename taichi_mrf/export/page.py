"""A map as one HTML file that any browser opens, without this program and without a network.

The file holds the scene of the live page, made by the same classes, as viser serializes it.
"""

from pathlib import Path

import numpy as np

from taichi_mrf.geometry.up import Z_UP, Up
from taichi_mrf.queries.colored import ColoredMap, shown_colors_in
from taichi_mrf.queries.known_bricks import BrickReader, QueriedMap
from taichi_mrf.system.atomic import write_text
from taichi_mrf.viewer.messages import pack_log_odds
from taichi_mrf.viewer.scene.cell_clouds import add_cells
from taichi_mrf.viewer.scene.look import look_of
from taichi_mrf.viewer.scene.options import ColorBy, ViewOptions
from taichi_mrf.viewer.scene.viewpoint import ViewpointController
from taichi_mrf.viewer.scene.voxel_layer import VoxelLayer
from taichi_mrf.viewer.transport.server import start_server
from taichi_mrf.viewer.transport.standalone import standalone_page
from taichi_mrf.voxels.layout import BRICK, VOXELS

_NOT_SHOWN = np.float32(-60)
"""Log-odds below any threshold."""


def write_page(
    path: str | Path,
    m: QueriedMap,
    threshold: float = 0.5,
    up: Up | None = None,
    colored: ColoredMap | None = None,
    cells: bool = False,
) -> None:
    """Write a page that shows the voxels of at least this probability, ``up`` pointing up (default: the
    map's), by their marginals or in the colours of ``colored``, the same map; with ``cells`` also the cells
    that stand in for voxels (queries/cells.py). Raises MapFileError, ViewerError."""
    color_by: ColorBy = "marginal" if colored is None else "photo"
    server = start_server("127.0.0.1", 0, Path(path).stem)
    try:
        layer = VoxelLayer(server.scene, "/voxels", m.voxel_size)
        reader = BrickReader(m)
        prior, min_evidence = reader.pool.prior_log_odds, m.view.volume.min_evidence
        for bricks, log_odds, _ in reader.batches(reader.bricks):
            # Some maps give unseen voxels a probability of one half; those must not be shown.
            seen = np.where(log_odds == prior, _NOT_SHOWN, log_odds)
            layer.store.put(bricks, pack_log_odds(seen), np.zeros((len(bricks), VOXELS), np.uint8))
            if colored is not None:
                layer.store.paint(bricks, shown_colors_in(colored, reader.slots(bricks)))
        eye = ViewpointController(server)
        eye.set_up(up or m.up or Z_UP)
        bounds = layer.store.bounds()
        if bounds is not None:
            options = ViewOptions(color_by=color_by, threshold=threshold)
            look = look_of(options, layer.store, eye.up, m.voxel_size)
            layer.prepare(layer.all_chunks(), look, exactly=True)
            layer.send()
            if cells:
                add_cells(server.scene, layer.store, look, m.voxel_size, prior + min_evidence)
            low, high = (end.astype(np.float64) * BRICK * m.voxel_size for end in (bounds[0], bounds[1] + 1))
            eye.map_grew(low, high)
        write_text(path, standalone_page(server.get_scene_serializer(), dark=False))
    finally:
        server.stop()
