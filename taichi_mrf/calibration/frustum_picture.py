"""The coverage of the view frustum as a picture: over the image, from above, from the side, in slices.

As the paper's Fig. 4 during a recording: the cells that still lack data.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.coverage import Coverage
from taichi_mrf.evaluation.pictures.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SLICES = 8
_COLORS = "RdYlBu"
"""Red lacks data, blue has enough; green would be hard to tell from red for many readers."""


def frustum_picture(coverage: Coverage, counts: NDArray[np.int64]) -> "Figure":
    """Draw the coverage; ``counts`` are the samples of each cell, (patches, bins)."""
    figure = new_figure(13.0, 8.5)
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 1.15)))
    number, above, aside = top.subplots(1, 3)
    _draw_counts(number, coverage, counts)
    _draw_section(above, coverage, horizontal=True)
    _draw_section(aside, coverage, horizontal=False)
    _draw_slices(bottom, coverage)
    return figure


def _grid(coverage: Coverage, values: NDArray[np.floating]) -> NDArray[np.floating]:
    return values.reshape(coverage.cells.rows, coverage.cells.columns, *values.shape[1:])


def image_extent(coverage: Coverage) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of the patches' grid in pixels, for ``imshow``."""
    cells = coverage.cells
    patch = cells.options.patch
    return (-0.5, cells.columns * patch - 0.5, cells.rows * patch - 0.5, -0.5)


def within_image(axes: "Axes", coverage: Coverage) -> None:
    """Show the image's pixels only, without the overhang of the last patches."""
    camera = coverage.cells.camera
    axes.set(xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5))


def _draw_counts(axes: "Axes", coverage: Coverage, counts: NDArray[np.int64]) -> None:
    from matplotlib.colors import LogNorm

    total = _grid(coverage, counts.sum(axis=1).astype(np.float64))
    norm = LogNorm(max(1.0, total[total > 0].min()), max(10.0, total.max()))
    image = axes.imshow(np.where(total > 0, total, np.nan), norm=norm, extent=image_extent(coverage))
    axes.set_facecolor("0.8")
    axes.set(title="Samples of each patch, all depths", xlabel="column, pixels", ylabel="row, pixels")
    within_image(axes, coverage)
    axes.figure.colorbar(image, ax=axes, shrink=0.8)


def _draw_section(axes: "Axes", coverage: Coverage, horizontal: bool) -> None:
    """The frustum from above (or from its side): share of the patches of a column (or row) with enough."""
    cells = coverage.cells
    camera, patch = cells.camera, cells.options.patch
    grid = _grid(coverage, coverage.covered.astype(np.float64))
    if horizontal:
        share, size, centre, focal = grid.mean(axis=0), camera.width, camera.cx, camera.fx
    else:
        share, size, centre, focal = grid.mean(axis=1), camera.height, camera.cy, camera.fy
    pixels = np.minimum(np.arange(len(share) + 1) * patch, size) - 0.5
    slope = (pixels - centre) / focal
    across, depth = slope[:, None] * cells.edges, np.broadcast_to(cells.edges, (len(slope), len(cells.edges)))
    if horizontal:
        axes.pcolormesh(across, depth, share, cmap=_COLORS, vmin=0, vmax=1)
        axes.set(title="From above: share of each column", xlabel="right, m", ylabel="depth, m")
    else:
        axes.pcolormesh(depth, across, share, cmap=_COLORS, vmin=0, vmax=1)
        axes.invert_yaxis()
        axes.set(title="From the side: share of each row", xlabel="depth, m", ylabel="down, m")
    axes.set_aspect("equal")


def _draw_slices(figure: "Figure", coverage: Coverage) -> None:
    """Images of the patches at depths from near to far: the share of the slice's bins with enough."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    cells = coverage.cells
    groups = np.array_split(np.arange(cells.bins), min(SLICES, cells.bins))
    columns = (len(groups) + 1) // 2
    all_axes = np.atleast_1d(figure.subplots(-(-len(groups) // columns), columns)).ravel()
    for axes, bins in zip(all_axes, groups, strict=False):
        share = _grid(coverage, coverage.covered[:, bins].mean(axis=1))
        axes.imshow(share, cmap=_COLORS, vmin=0, vmax=1, extent=image_extent(coverage))
        within_image(axes, coverage)
        near, far = cells.edges[bins[0]], cells.edges[bins[-1] + 1]
        axes.set_title(f"{near:.2f} to {far:.2f} m: {share.mean():.0%}", fontsize=10)
        axes.set(xticks=[], yticks=[])
    for axes in all_axes[len(groups) :]:
        axes.remove()
    figure.colorbar(
        ScalarMappable(Normalize(0, 1), _COLORS),
        ax=list(all_axes[: len(groups)]),
        label=f"share of cells with at least {cells.options.least_count} samples",
    )
