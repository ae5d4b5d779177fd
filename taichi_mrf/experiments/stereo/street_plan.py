"""Maps of a street from above, one below the other, with their artefacts marked."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from taichi_mrf.evaluation.artefacts import Sightings
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.scenes import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEIGHTS_M = (-2.5, 4.0)
"""Range of the colours, metres above the first camera; a car carries its cameras at 1.7 m."""

ARTEFACT_COLOR = "#e6007e"
"""Magenta: on none of the colour scales."""


def plan(seen: Sightings, scene: Scene, voxel_size: float, occupied_from: float) -> Result:
    """The columns of occupied voxels in the frame of the first camera, which looks ahead along a level
    street: ``ahead`` and ``right`` in voxels, ``top`` the height of the highest one in metres, and whether
    any is an ``artefact``."""
    T = scene.views[0].T_world_camera
    occupied = seen.probability >= occupied_from
    right, down, ahead = ((seen.centres[occupied] - T[:3, 3]) @ T[:3, :3]).T
    cells = np.floor(np.stack([ahead, right], axis=1) / voxel_size).astype(np.int64)
    columns, column_of = np.unique(cells, axis=0, return_inverse=True)
    column_of = column_of.reshape(-1)
    top = np.full(len(columns), -np.inf)
    np.maximum.at(top, column_of, -down)
    artefact = np.zeros(len(columns), bool)
    np.logical_or.at(artefact, column_of, seen.artefacts()[occupied])
    return {
        "ahead": columns[:, 0].tolist(),
        "right": columns[:, 1].tolist(),
        "top": [round(float(t), 1) for t in top],
        "artefact": artefact.astype(int).tolist(),
        "artefacts": int(seen.artefacts()[occupied].sum()),
        "coverage": seen.coverage(occupied_from),
        "occupied_from": occupied_from,
    }


def plan_figure(plans: Mapping[str, Result], scene: Scene, voxel_size: float) -> "Figure":
    """A panel for each map, the street ahead to the right; artefacts are drawn larger than they are."""
    from matplotlib import colormaps

    ahead = np.concatenate([np.asarray(p["ahead"], float) for p in plans.values()])
    right = np.concatenate([np.asarray(p["right"], float) for p in plans.values()])
    if not len(ahead):
        ahead = right = np.zeros(1)
    # A few far voxels would make all others small.
    (x_low, x_high), (y_low, y_high) = (np.quantile(v, [0.002, 0.998]) for v in (ahead, right))
    shape = (int(y_high - y_low) + 1, int(x_high - x_low) + 1)
    extent = (x_low * voxel_size, (x_high + 1) * voxel_size, (y_high + 1) * voxel_size, y_low * voxel_size)
    height_in = max(1.2, 11.0 * shape[0] / shape[1])
    figure = new_figure(12.5, (height_in + 0.45) * len(plans) + 0.6)
    axes_of_all = figure.subplots(len(plans), 1, squeeze=False, sharex=True)[:, 0]
    T = scene.views[0].T_world_camera
    way = np.array([(view.T_world_camera[:3, 3] - T[:3, 3]) @ T[:3, :3] for view in scene.views[::2]])
    for axes, (name, drawn) in zip(axes_of_all, plans.items(), strict=True):
        image = np.full(shape, np.nan)
        row = (np.asarray(drawn["right"], float) - y_low).astype(int)
        column = (np.asarray(drawn["ahead"], float) - x_low).astype(int)
        inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        image[row[inside], column[inside]] = np.asarray(drawn["top"], float)[inside]
        shown = axes.imshow(
            image, extent=extent, cmap=colormaps["viridis"], vmin=HEIGHTS_M[0], vmax=HEIGHTS_M[1],
            interpolation="nearest",
        )  # fmt: skip
        wrong = inside & np.asarray(drawn["artefact"], bool)
        axes.plot(
            (np.asarray(drawn["ahead"])[wrong] + 0.5) * voxel_size,
            (np.asarray(drawn["right"])[wrong] + 0.5) * voxel_size,
            ".", color=ARTEFACT_COLOR, markersize=2.5,
        )  # fmt: skip
        axes.plot(way[:, 2], way[:, 0], "-", color="black", linewidth=1.0)
        axes.set(
            title=f"{name}: {drawn['artefacts']} artefacts (magenta) at P >= {drawn['occupied_from']:.2f}, "
            f"which covers {100 * drawn['coverage']:.0f} %",
            xlim=extent[:2], ylim=extent[2:],
        )  # fmt: skip
    axes_of_all[-1].set_xlabel("metres ahead; black: way of the camera")
    figure.colorbar(
        shown, ax=list(axes_of_all), location="bottom", shrink=0.5, aspect=40, pad=0.01,
        label="highest voxel (m above the camera)",
    )  # fmt: skip
    return figure
