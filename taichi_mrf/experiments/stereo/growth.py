"""Schauwecker & Zell's Fig. 5a: how far the map reaches when one image is integrated again and again."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import PinholeCamera
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.experiments.contenders import Contender
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.noise import NoiseModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CORRIDOR_M = 25.0
"""Length of the corridor in front of the camera."""

CORRIDOR_WALLS_M = ((-1.13, 1.27), (-1.38, 1.12))
"""Walls, ceiling and floor of the corridor from the camera: 2.4 m wide and 2.5 m high, off the grid."""

CORRIDOR_CAMERA = PinholeCamera(320, 240, 270.0, 270.0, 159.5, 119.5)
PAPER_M, PAPER_UPDATES = 10.0, 65
"""At 0.2 m voxels the paper's map reaches about 10 m after 65 updates."""


def corridor_scene(noise: NoiseModel) -> Scene:
    """One exact view along a corridor, as a camera would measure it that has ``noise`` but errs by 0."""
    T_world_camera = look_at([0.0, 0.0, 0.0], [0.05, 0.0, 1.0], up=[0.0, -1.0, 0.0])
    directions = CORRIDOR_CAMERA.rays() @ T_world_camera[:3, :3].T
    nearest = CORRIDOR_M / np.maximum(directions[..., 2], 1e-9)
    for axis, (low, high) in enumerate(CORRIDOR_WALLS_M):
        along = directions[..., axis]
        wall = np.where(along < 0, low, high) / np.where(along == 0, 1e-9, along)
        nearest = np.minimum(nearest, np.abs(wall))
    depth_m = nearest.astype(np.float32)
    view = SceneView("corridor", T_world_camera, depth_m, depth_m, depth_m > 0)
    return Scene("corridor", CORRIDOR_CAMERA, noise, VolumeConfig(), 2 * CORRIDOR_M, [view])


def grow(contender: Contender, scene: Scene, voxel_size: float, updates: int, every: int) -> Result:
    """Integrate a scene's first view ``updates`` times; ``farthest_m`` is the distance from the camera of the
    farthest voxel with P(O) > 0.5 after each number of ``updates``, 0 while there is none."""
    m, view = contender.make(scene, voxel_size), scene.views[0]
    counts, farthest = [], []
    for count in range(1, updates + 1):
        m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
        if count == 1 or count % every == 0:
            centres, probability = m.voxels(0.5)
            counts.append(count)
            farthest.append(_reach(centres[probability > 0.5], view.T_world_camera[:3, 3]))
    return {"updates": counts, "farthest_m": farthest}


def _reach(centres: NDArray[np.float64], camera: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(centres - camera, axis=1).max()) if len(centres) else 0.0


def updates_to(result: Result, distance_m: float) -> int | None:
    """The number of updates after which the map first reaches this far; None if it never does."""
    for count, farthest in zip(result["updates"], result["farthest_m"], strict=True):
        if farthest >= distance_m:
            return int(count)
    return None


def growth_figure(panels: Mapping[str, Mapping[str, Result]]) -> "Figure":
    """One panel for each scene, one line for each map in it."""
    figure = new_figure(5.6 * len(panels), 4.4)
    for axes, (title, lines) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        at_once = [result["farthest_m"][0] for result in lines.values() if len(result["updates"]) == 1]
        for number, farthest in enumerate(at_once):
            label = "_" if number else "OctoMap-style, after 1 update"
            axes.axhline(farthest, color="0.5", linestyle="--", label=label)
        for name, result in lines.items():
            if len(result["updates"]) > 1:
                axes.plot(result["updates"], result["farthest_m"], label=name)
        axes.plot(PAPER_UPDATES, PAPER_M, "k*", markersize=12, label="paper, 0.2 m")
        axes.set(xlabel="updates with one image", title=title, ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.axes[0].set_ylabel("farthest voxel with P(O) > 0.5 (m)")
    return figure


def growth_rows(panels: Mapping[str, Mapping[str, Result]], distances: Sequence[float]) -> list[list]:
    """Rows of a table: scene, map, what one update reaches, updates to each distance, what all reach."""
    return [
        [title, name, result["farthest_m"][0]]
        + [updates_to(result, distance) for distance in distances]
        + [result["updates"][-1], result["farthest_m"][-1]]
        for title, lines in panels.items()
        for name, result in lines.items()
    ]
