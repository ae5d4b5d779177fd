"""A floor plan of a map in chunks at the height of the cameras, with the submaps that it was made of."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.cluster.submaps.plan import Plan
from taichi_mrf.evaluation.pictures.figures import draw_camera_path, new_figure
from taichi_mrf.export.map_server import grey_image
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.queries.points import probability
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.voxels.layout import CHUNK_VOXELS

BAND_M = 0.3
"""The plan shows voxels from this far below the lowest camera to this far above the highest."""

MARGIN_M = 1.0
"""Margin around the known voxels."""

BLUE = "tab:blue"
MOST_PIXELS = 2000
"""Along the longer side; in a larger map several voxels share a pixel, which shows the one most likely
occupied."""


def write_submap_picture(
    path: Path, m: ChunkedMap, plan: Plan, centres_m: Sequence[tuple[float, float, float]]
) -> None:
    """Draw the plan, chunk by chunk; ``centres_m`` are the cameras' places. Raises MapFileError."""
    eyes = np.array(centres_m)
    lower, upper = m.extent
    lower[2], upper[2] = eyes[:, 2].min() - BAND_M, eyes[:, 2].max() + BAND_M
    likeliest = _likeliest(m, lower, upper)
    pixel = (upper - lower)[:2] / likeliest.shape
    known = np.argwhere(~np.isnan(likeliest))
    if not len(known):  # nothing at the cameras' height
        known = np.array([(0, 0), np.array(likeliest.shape) - 1])
    low, high = (
        lower[:2] + pixel * known.min(axis=0) - MARGIN_M,
        lower[:2] + pixel * known.max(axis=0) + MARGIN_M,
    )
    inches = 10 * (high - low) / (high - low).max()
    figure = new_figure(max(6.0, float(inches[0])) + 1.0, float(inches[1]) + 1.2)
    axes = figure.add_subplot()
    grey = grey_image((likeliest >= 0.5).T, ~np.isnan(likeliest).T)
    axes.imshow(grey, cmap="gray", vmin=0, vmax=255, extent=(lower[0], upper[0], lower[1], upper[1]))
    across = plan.chunks_across * CHUNK_VOXELS * m.voxel_size
    for submap in plan.submaps:
        x, y = across * submap.cell[0], across * submap.cell[1]
        axes.plot(
            *np.array([(x, y), (x + across, y), (x + across, y + across), (x, y + across), (x, y)]).T,
            color=BLUE,
        )
        # Within the picture also where only a corner of the column is.
        left, bottom = np.maximum((x, y), low) + 0.03 * across
        axes.text(left, bottom, str(len(submap.keyframes)), color=BLUE, fontsize=9, clip_on=True)
    draw_camera_path(axes, eyes[:, :2])
    title = f"{len(plan.submaps)} submaps with the number of their keyframes, of {len(eyes)}"
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x (m)", ylabel="y (m)", title=title)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _likeliest(m: ChunkedMap, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.float32]:
    """(columns, rows): the largest probability of occupied in the band above each place, NaN where nothing is
    known, for every chunk of the box or, of a large map, for squares of several voxels."""
    first = m.chunks.min(axis=0)[:2]
    chunks = m.chunks.max(axis=0)[:2] - first + 1
    shared = 1
    while chunks.max() * CHUNK_VOXELS // shared > MOST_PIXELS and shared < CHUNK_VOXELS:
        shared *= 2
    pixels = CHUNK_VOXELS // shared
    plan = np.full(chunks * pixels, np.nan, np.float32)
    heights = np.arange(CHUNK_VOXELS) + 0.5
    for chunk, block in m.blocks(lower, upper):
        z = (chunk[2] * CHUNK_VOXELS + heights) * m.voxel_size
        band = block[:, :, (z >= lower[2]) & (z <= upper[2])]
        if band.shape[2]:
            known = np.abs(band - m.header.prior_log_odds) > m.header.min_evidence
            band = np.where(known, band, np.float32(np.nan))
            highest = np.fmax.reduce(band.reshape(pixels, shared, pixels, shared, -1), axis=(1, 3, 4))
            x, y = ((np.array(chunk[:2]) - first) * pixels).tolist()
            place = plan[x : x + pixels, y : y + pixels]
            place[:] = np.fmax(place, probability(highest))
    return plan
