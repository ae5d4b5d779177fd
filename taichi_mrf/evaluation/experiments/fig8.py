"""MRFMap's Figs. 8 and 9: the occupied voxels of OctoMap's model and of MRFMap side by side, from one place.

Fig. 8 shows Table II's room by height, Fig. 9 Table III's recording by probability.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.experiments.contenders import log_odds, mrf
from taichi_mrf.evaluation.experiments.folds import Experiment, require_views
from taichi_mrf.evaluation.experiments.judging import build
from taichi_mrf.evaluation.experiments.scenes import Scene, kitchen_scene, living_room_scene
from taichi_mrf.evaluation.experiments.table2 import keyframes_of_room
from taichi_mrf.evaluation.pictures.figures import color_bar, new_figure
from taichi_mrf.evaluation.pictures.room_views import DrawnMap, voxels_from
from taichi_mrf.evaluation.pictures.surfaces import cell_keys, seen_surfaces, up_direction, upward_axis
from taichi_mrf.evaluation.pictures.viewpoint import (
    HEIGHT_COLORS,
    HEIGHT_LABEL,
    PERSPECTIVE,
    height_span,
    overview_pose,
)
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROBABILITY_COLORS = "plasma"
"""From dark violet to bright yellow, as in the paper."""


def run_fig8(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """One picture of the living room for each voxel size, and how many voxels lie away from all surfaces."""
    scene = living_room_scene(experiment.data, experiment.seeds[0], experiment.limit)
    return _side_by_side(experiment, "fig8", scene, keyframes_of_room(experiment, scene)[0], by_height=True)


def run_fig9(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """One picture of the real recording for each voxel size."""
    scene = kitchen_scene(experiment.data, experiment.limit)
    return _side_by_side(experiment, "fig9", scene, range(0, len(scene.views), 2), by_height=False)


def _side_by_side(
    experiment: Experiment, name: str, scene: Scene, keyframes: Sequence[int], *, by_height: bool
) -> tuple[list[Table], list[Path]]:
    require_views(scene, 1)
    rows: list[list[Entry]] = []
    paths: list[Path] = []
    contenders = [log_odds("OctoMap-style"), mrf()]
    for voxel_size in experiment.voxel_sizes:
        maps: list[OccupancyMap] = []
        for number, contender in enumerate(contenders):
            experiment.report(f"{contender.name}, {voxel_size * 100:g} cm", number, len(contenders))
            maps.append(build(contender, scene, voxel_size, keyframes)[0])
        near = (
            _near_surfaces(scene, voxel_size) if by_height else None
        )  # a recording's own noise is near itself
        for contender, m in zip(contenders, maps, strict=True):
            centres, _ = m.decided.voxels(min_probability=0.5)
            away = None
            if near is not None and len(centres):
                away = float(np.mean(~np.isin(cell_keys(centres, voxel_size), near)))
            rows.append([f"{voxel_size * 100:g} cm", contender.name, len(centres), away])
        path = experiment.out / f"{name}_{voxel_size * 1000:g}mm.png"
        with atomic_path(path) as temporary:
            figure = _figure(scene, maps, [each.name for each in contenders], by_height=by_height)
            figure.savefig(temporary, dpi=130)
        paths.append(path)
    table = Table(
        name, f"{scene.name}: what is occupied", ["voxels", "map", "occupied", "away from surfaces"], rows,
        [
            f"{len(keyframes)} keyframes. Away: no depth that judges one of {len(scene.views)} views ends in "
            "the voxel or beside it."
        ],
    )  # fmt: skip
    return [table], [*write_table(experiment.out, table), *paths]


def _near_surfaces(scene: Scene, voxel_size: float) -> NDArray[np.int64]:
    """Keys of the voxels in or beside which a depth of some view ends."""
    found = np.zeros(0, np.int64)
    steps = voxel_size * (np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 1, 3))
    for view in scene.views:
        rays = (view.camera or scene.camera).rays()[view.judged]
        ends = rays * view.true_m[view.judged][:, None] @ view.T_world_camera[:3, :3].T
        ends += view.T_world_camera[:3, 3]
        _, first = np.unique(cell_keys(ends, voxel_size), return_index=True)
        found = np.union1d(found, cell_keys((ends[first] + steps).reshape(-1, 3), voxel_size))
    return found


def _figure(scene: Scene, maps: Sequence[OccupancyMap], names: Sequence[str], *, by_height: bool) -> "Figure":
    """Both maps from where most of the last one's surfaces is seen, which also tells what faces away."""
    import cv2
    from matplotlib import colormaps

    last = maps[-1]
    seen, cameras = seen_surfaces(last), list(last.keyframes.values())
    up = up_direction([upward_axis(each) for each in cameras], seen.normals)
    normals, found = seen.thickened(), [m.decided.voxels(min_probability=0.5) for m in maps]
    if not len(found[-1][0]):
        raise ConfigError(f"{scene.name}: {names[-1]} has no occupied voxel of {last.voxel_size:g} m to draw")
    drawn = [DrawnMap(each, normals.normals_at(each), last.voxel_size, up, []) for each, _ in found]
    pose = overview_pose(drawn[-1].centres, drawn[-1].normals, up, PERSPECTIVE, last.voxel_size)
    floor, height_m = height_span(drawn[-1].centres @ up, last.voxel_size)
    figure = new_figure(18.0, 6.4)
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, room, (centres, p), name in zip(panels, drawn, found, names, strict=True):
        value, colors = ((centres @ up - floor) / height_m, HEIGHT_COLORS) if by_height else (
            2.0 * p - 1.0, PROBABILITY_COLORS
        )  # fmt: skip
        picture = voxels_from(room, pose, colormaps[colors](value, bytes=True)[:, :3])
        size = (PERSPECTIVE.width, PERSPECTIVE.height)
        axes.imshow(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
        axes.set_title(f"{name}: {len(centres):,} occupied voxels of {100 * last.voxel_size:.3g} cm")
        axes.axis("off")
    scale = (HEIGHT_COLORS, 0.0, height_m, HEIGHT_LABEL)
    color_bar(panels[-1], *(scale if by_height else (PROBABILITY_COLORS, 0.5, 1.0, "probability")))
    return figure
