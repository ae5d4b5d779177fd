"""The pictures that a mapping run leaves behind: its surface, from above, and beside the measurements."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.held_out import depth_error, surface_depth
from taichi_mrf.evaluation.pictures.figures import new_figure, notice, write_figure
from taichi_mrf.evaluation.pictures.room_views import (
    DrawnMap,
    DrawnSurface,
    perspective,
    smooth_borders,
    surface_view,
    top_view,
)
from taichi_mrf.evaluation.pictures.surfaces import seen_surfaces, up_direction, upward_axis
from taichi_mrf.geometry.up import Z_UP
from taichi_mrf.methods.capabilities import measures_surface
from taichi_mrf.methods.protocol import OccupancyMap, PosedDepth
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.unrolled import unrolled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Depth = NDArray[np.float32]

_DEPTH_ROWS = 3
"""Frames in the depth picture, at most."""

_DIFFERENCE_RANGE_CM = 10.0
_NO_DEPTH_GREY = "0.88"

_LABELS = "depth (m); grey: none", "rendered − measured (cm)"
NOTHING = np.zeros((0, 3))
_LOW = 0.5
"""Height over width of pictures beside which the labels have no room."""


def write_pictures(
    out_dir: Path, m: OccupancyMap, held_out: Sequence[Frame], rendered_m: Sequence[Depth] = ()
) -> list[Path]:
    """Write ``surface.png``, ``top_view.png`` and ``depth.png`` to a folder that exists; where the map has no
    measured surface, ``perspective.png`` shows its voxels instead.

    ``held_out`` are frames that the map has not seen, to compare rendered with measured depth; without
    any a keyframe serves, and its title says so. ``rendered_m`` are the depths (H, W) that the map predicts
    for them, if these are known. Returns the paths. Raises MapFileError.
    """
    figures = {**_whole_map(m), "depth.png": depth_comparison(m, held_out, rendered_m)}
    for name, figure in figures.items():
        write_figure(figure, out_dir / name)
    return [out_dir / name for name in figures]


def _whole_map(m: OccupancyMap) -> dict[str, "Figure"]:
    """The views of the whole map, by file name."""
    cameras = list(m.keyframes.values())
    poses, upwards = [each.T_world_camera for each in cameras], [upward_axis(each) for each in cameras]
    surface = m.surface() if measures_surface(m) and m.has_surface else None
    if surface is not None and len(surface.triangles):
        up = up_direction(upwards, surface.normals, m.up or Z_UP)
        vertices_m = smooth_borders(surface.vertices_m, surface.triangles)
        drawn = DrawnSurface(vertices_m, surface.triangles, surface.normals, surface.colors)
        room = DrawnMap(NOTHING, NOTHING, m.voxel_size, up, poses)
        return {"surface.png": surface_view(drawn, m.voxel_size, up), "top_view.png": top_view(room, drawn)}
    centres, _ = m.decided.voxels(min_probability=0.5)
    if len(centres) == 0:
        nothing = notice("The map holds no occupied voxel.")
        return {"perspective.png": nothing, "top_view.png": nothing}
    seen = seen_surfaces(m)
    up = up_direction(upwards, seen.normals, m.up or Z_UP)
    room = DrawnMap(centres, seen.thickened().normals_at(centres), m.voxel_size, up, poses)
    return {"perspective.png": perspective(room), "top_view.png": top_view(room)}


def depth_comparison(
    m: OccupancyMap, held_out: Sequence[Frame], rendered_m: Sequence[Depth] = ()
) -> "Figure":
    """Depth as it was measured, but for the sensor's bias, rendered depth, and their difference, a row for
    each of a few frames; those without a flat image are unrolled.

    Without held-out frames it shows a keyframe, and says so.
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    frames: list[PosedDepth] = list(held_out) or list(m.keyframes.values())
    if not frames:
        return notice("There is no frame to compare the map with.")
    kind, rows = ("held-out frame", min(_DEPTH_ROWS, len(frames))) if held_out else ("keyframe", 1)
    # The middles of equal shares of the recording.
    middles = [int((row + 0.5) * len(frames) / rows) for row in range(rows)]
    chosen = [frames[at] for at in middles]
    depths_m = [rendered_m[at] for at in middles] if rendered_m else [_rendered(m, each) for each in chosen]
    depth_colors = colormaps["turbo"].with_extremes(bad=_NO_DEPTH_GREY)
    difference_colors = colormaps["RdBu_r"].with_extremes(bad=_NO_DEPTH_GREY)
    limit = Normalize(-_DIFFERENCE_RANGE_CM, _DIFFERENCE_RANGE_CM)
    pictures = [unrolled(frame.camera) for frame in chosen]
    aspect = max(picture.camera.height / picture.camera.width for picture in pictures)
    figure = new_figure(15.0, rows * (4.3 * aspect + 0.35) + 0.1)
    panels = figure.subplots(rows, 3, squeeze=False)
    for axes, frame, depth_m, picture in zip(panels, chosen, depths_m, pictures, strict=True):
        rendered = np.asarray(depth_m, np.float64)
        measured = surface_depth(frame, m.noise)
        measured[measured == 0] = np.nan
        error = depth_error(rendered, measured)
        depths = np.concatenate([image[np.isfinite(image)] for image in (measured, rendered)])
        scale = Normalize(*np.quantile(depths, [0.01, 0.99])) if depths.size else Normalize(0.0, 1.0)
        measured, rendered = (picture.image(image, np.nan) for image in (measured, rendered))
        axes[0].imshow(measured, cmap=depth_colors, norm=scale)
        axes[0].set_title(f"measured, {kind} {frame.name}")
        shown = axes[1].imshow(rendered, cmap=depth_colors, norm=scale)
        axes[1].set_title(f"rendered, {100 * error.unanswered:.1f} % without a surface")
        difference = axes[2].imshow(100.0 * (rendered - measured), cmap=difference_colors, norm=limit)
        axes[2].set_title(
            f"median error {100 * error.median_abs:.1f} cm, signed {100 * error.median:+.1f} cm"
        )
        depth_label, difference_label = ("m", "cm") if aspect < _LOW else _LABELS
        figure.colorbar(shown, ax=axes[:2], label=depth_label, shrink=0.93, pad=0.01)
        figure.colorbar(difference, ax=axes[2], label=difference_label, extend="both", shrink=0.93, pad=0.02)
        for ax in axes:
            ax.set(xticks=[], yticks=[])
    return figure


def _rendered(m: OccupancyMap, frame: PosedDepth) -> Depth:
    return m.render_depth(frame.camera, frame.T_world_camera)
