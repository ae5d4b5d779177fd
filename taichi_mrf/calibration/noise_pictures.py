"""Pictures of the learnt noise, bias and sigma against depth and over the image, and of the view frustum's
coverage: over the image, from above, from the side, in slices (the paper's Fig. 4 during a recording).
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.coverage import Coverage
from taichi_mrf.calibration.fit import LearntNoise
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


_LINE, _CENTRE, _POINTS = "#1f4e9c", "#c8102e", "0.35"
_MAP_DEPTHS = 3
_MM = 1e3


def central_third(noise: LearntNoise) -> NDArray[np.bool_]:
    """The patches in the middle third of rows and columns, (patches,): those of the paper's Fig. 5."""
    rows, columns = noise.cells.rows, noise.cells.columns
    row, column = np.divmod(np.arange(rows * columns), columns)
    inner_row = np.abs(row - (rows - 1) / 2) <= rows / 6
    return inner_row & (np.abs(column - (columns - 1) / 2) <= columns / 6)


def curves_picture(noise: LearntNoise, coverage: Coverage) -> "Figure":
    """Bias and sigma against depth: patches' median and spread, the centre of the image, and the bins."""
    figure = new_figure(12.0, 5.0)
    left, right = figure.subplots(1, 2)
    _draw_curves(left, noise, coverage, noise.bias.at, noise.mean_error)
    left.axhline(0.0, color="0.6", linewidth=0.8)
    left.set(title="Bias: measured minus true", xlabel="true depth, m", ylabel="bias, mm")
    _draw_curves(right, noise, coverage, noise.sigma.at, noise.spread)
    right.set_ylim(bottom=0.0)
    right.set(title="Sigma: standard deviation", xlabel="true depth, m", ylabel="sigma, mm")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return figure


def maps_picture(noise: LearntNoise, coverage: Coverage) -> "Figure":
    """Bias and sigma of each patch over the image at three depths of the covered range; dots mark patches
    that borrowed from their neighbours."""
    near, far = coverage.depth_range()
    depths = near + (far - near) * (np.arange(_MAP_DEPTHS) + 0.5) / _MAP_DEPTHS
    figure = new_figure(13.0, 6.5)
    all_axes = figure.subplots(2, _MAP_DEPTHS)
    for axes_row, curves, name in ((all_axes[0], noise.bias, "bias"), (all_axes[1], noise.sigma, "sigma")):
        values = curves.at(depths) * _MM
        for axes, depth, value in zip(axes_row, depths, values.T, strict=True):
            low, high = np.quantile(value, [0.02, 0.98])
            colors = "viridis"
            if low < 0 < high:  # white is no bias
                colors, high = "RdBu_r", max(-low, high)
                low = -high
            grid = value.reshape(noise.cells.rows, noise.cells.columns)
            image = axes.imshow(grid, cmap=colors, vmin=low, vmax=high, extent=image_extent(coverage))
            _mark_borrowed(axes, noise)
            within_image(axes, coverage)
            axes.set(title=f"{name} at {depth:.2f} m", xticks=[], yticks=[])
            figure.colorbar(image, ax=axes, label="mm", shrink=0.9)
    if not noise.own.all():
        figure.supxlabel(f"Dots: {int((~noise.own).sum())} patches that borrowed from others", fontsize=10)
    return figure


def _draw_curves(
    axes: "Axes",
    noise: LearntNoise,
    coverage: Coverage,
    at: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    cells: NDArray[np.float64],
) -> None:
    options, edges = noise.cells.options, noise.cells.edges
    depth = np.linspace(options.min_depth, options.max_depth, 200)
    values = at(depth) * _MM
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9], axis=0)
    axes.fill_between(depth, low, high, color=_LINE, alpha=0.18, label="8 of 10 patches", linewidth=0)
    axes.plot(depth, median, color=_LINE, label="median patch")
    centre = values[central_third(noise)].mean(axis=0)
    axes.plot(depth, centre, color=_CENTRE, linestyle="--", label="mean of the image's centre")
    filled = np.flatnonzero(noise.covered.any(axis=0))
    middle = 0.5 * (edges[:-1] + edges[1:])[filled]
    points = np.nanmedian(cells[:, filled], axis=0) * _MM
    axes.plot(middle, points, "o", color=_POINTS, markersize=3.5, label="bins, median of the patches")
    near, far = coverage.depth_range()
    label = "too few samples"
    for first, last in ((options.min_depth, near), (far, options.max_depth)):
        if last > first:
            axes.axvspan(first, last, color="0.88", zorder=0, linewidth=0, label=label)
            label = ""
    _limit(axes, np.concatenate([low, high, centre]), np.tile((depth >= near) & (depth <= far), 3), points)
    axes.set_xlim(options.min_depth, options.max_depth)


def _limit(
    axes: "Axes", values: NDArray[np.float64], inside: NDArray[np.bool_], points: NDArray[np.float64]
) -> None:
    """Scale the axis by what is covered; extrapolated curves may leave the picture."""
    shown = np.concatenate([values[inside], points, [0.0]])
    margin = 0.25 * max(float(np.ptp(shown)), 1.0)
    axes.set_ylim(shown.min() - margin, shown.max() + margin)


def _mark_borrowed(axes: "Axes", noise: LearntNoise) -> None:
    patch = noise.cells.options.patch
    row, column = np.divmod(np.flatnonzero(~noise.own), noise.cells.columns)
    axes.plot((column + 0.5) * patch - 0.5, (row + 0.5) * patch - 0.5, ".", color="black", markersize=2.0)
