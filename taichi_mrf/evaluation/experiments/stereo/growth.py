"""Growth of the stereo maps with images, voxel size and resolution, and artefacts against coverage, which a
map's threshold trades for each other.

Schauwecker & Zell's Fig. 5: how far the map reaches when one image is integrated again and again (a), and
time and memory against voxel size and image resolution (b, c).
"""

import statistics
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import PinholeCamera
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.evaluation.artefacts import MAJORITY, Sightings
from taichi_mrf.evaluation.bench import octomap_available
from taichi_mrf.evaluation.experiments.contenders import Contender
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.evaluation.experiments.stereo.street import TABLE_I, thinned
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.system.compiler import ti

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MAJORITIES = (0.5, MAJORITY, 0.9)
"""Shares of rays from which on a voxel is seen through: the measure's own, one milder and one stricter."""

LOG_ODDS = np.arange(-3.5, 7.0, 0.05)
"""Thresholds of the sweep: finer than any update."""


def curve(seen: Sightings, least_probability: float) -> Result:
    """For each threshold from ``least_probability`` on: coverage, how many voxels are occupied, how many of
    them can be judged, and how many are artefacts under each majority."""
    thresholds = 1.0 / (1.0 + np.exp(-LOG_ODDS))
    thresholds = np.concatenate([[least_probability], thresholds[thresholds > least_probability]])
    artefacts = {majority: seen.artefacts(majority) for majority in MAJORITIES}
    occupied = [seen.probability >= threshold for threshold in thresholds]
    return {
        "threshold": thresholds.tolist(),
        "coverage": [seen.coverage(threshold) for threshold in thresholds],
        "occupied": [int(o.sum()) for o in occupied],
        "judged": [int((o & seen.judged).sum()) for o in occupied],
        "artefacts": {
            f"{majority:g}": [int((o & each).sum()) for o in occupied] for majority, each in artefacts.items()
        },
    }


def artefacts_at(result: Result, coverage: float, majority: float = MAJORITY) -> float | None:
    """Artefacts where the threshold leaves this coverage, between two thresholds in proportion; None if the
    map never has as much, or cannot be brought down to so little without being emptied."""
    covered = np.asarray(result["coverage"])
    covered = covered[covered > 0]
    if len(covered) == 0 or not covered[-1] <= coverage <= covered[0]:
        return None
    artefacts = np.asarray(result["artefacts"][f"{majority:g}"], float)[: len(covered)]
    # Coverage falls with the threshold; np.interp needs it to rise.
    return float(np.interp(coverage, covered[::-1], artefacts[::-1]))


def threshold_for(result: Result, coverage: float) -> int:
    """Place in the curve of the highest threshold that keeps this coverage, or else of the lowest one."""
    return max(0, int(np.sum(np.asarray(result["coverage"]) >= coverage)) - 1)


def curve_figure(results: Mapping[str, Result], marked: Sequence[float]) -> "Figure":
    """Artefacts over coverage, one line for each map; ``marked`` are coverages to compare at."""
    figure = new_figure(9.0, 5.6)
    axes = figure.add_subplot()
    for number, (name, result) in enumerate(results.items()):
        covered = np.asarray(result["coverage"])
        kept = covered > 0
        if not kept.any():
            axes.plot([], [], color=f"C{number}", label=f"{name}: covers nothing")
            continue
        artefacts = np.asarray(result["artefacts"][f"{MAJORITY:g}"])[kept]
        axes.plot(covered[kept], artefacts, ".-", color=f"C{number}", markersize=4, linewidth=1.0, label=name)
        half = int(np.argmax(np.asarray(result["threshold"])[kept] >= 0.5))
        axes.plot(
            covered[kept][half], artefacts[half], "o", color=f"C{number}", markersize=9, fillstyle="none"
        )
    for coverage in marked:
        axes.axvline(coverage, color="0.8", linewidth=0.8, zorder=0)
    axes.set(
        xlabel="coverage: held-out measurements with an occupied voxel near",
        ylabel="artefacts: occupied voxels that held-out views see through",
        title="Each line sweeps the probability from which a voxel is occupied; rings: 0.5",
        xlim=(0.0, 1.0),
    )
    axes.set_yscale("symlog", linthresh=10)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    return figure


CORRIDOR_M = 25.0
"""Length of the corridor in front of the camera."""

CORRIDOR_WALLS_M = ((-1.13, 1.27), (-1.38, 1.12))
"""Walls, ceiling and floor of the corridor from the camera: 2.4 m wide and 2.5 m high, off the grid."""

CORRIDOR_CAMERA = PinholeCamera(320, 240, 270.0, 270.0, 159.5, 119.5)
PAPER_M, PAPER_UPDATES = 10.0, 65
"""At 0.2 m voxels the paper's map reaches about 10 m after 65 updates."""

STRIDES: Mapping[int, str] = {1: "full", 2: "half", 4: "quarter"}
OCTOMAP = "OctoMap itself"


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
            centres, probability = m.marginals.voxels(0.5)
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


def time_mapping(contender: Contender, scene: Scene, voxel_size: float, views: int) -> Result:
    """Median seconds to add a view and infer, over the first ``views`` views mapped after a warm-up; then
    what the map holds: MB (10^6 bytes) of voxels and messages, and how many voxels something is known of."""
    _warm_up(contender, scene, voxel_size)
    m = contender.make(scene, voxel_size)
    seconds = []
    for view in scene.views[: 2 * views : 2]:
        start = time.perf_counter()
        id = m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)
        m.infer(keyframes=[id])
        ti.sync()
        seconds.append(time.perf_counter() - start)
    size = m.statistics()
    return {
        "seconds": statistics.median(seconds),
        "mb": size.bytes_per_voxel * size.voxels / 1e6,
        "voxels": len(m.marginals.voxels(0.0)[0]),
    }


def _warm_up(contender: Contender, scene: Scene, voxel_size: float) -> None:
    """Compile what is not compiled yet, on as few rays as will do."""
    small = thinned(scene, 16)
    m = contender.make(small, voxel_size)
    id = m.add_keyframe(small.views[0].measured_m, small.views[0].T_world_camera, small.camera)
    m.infer(keyframes=[id])
    ti.sync()


def time_octomap(scene: Scene, voxel_size: float, views: int) -> Result:
    """Time and memory of OctoMap itself, with the paper's parameters for it; ``voxels`` are its nodes."""
    import pyoctomap

    tree = pyoctomap.OcTree(voxel_size)
    tree.setProbHit(TABLE_I["hit"])
    tree.setProbMiss(TABLE_I["miss"])
    seconds = []
    for view in scene.views[: 2 * views : 2]:
        points, origin = _points(view, scene)
        start = time.perf_counter()
        tree.insertPointCloud(points, origin, scene.max_depth, False, False)
        seconds.append(time.perf_counter() - start)
    return {"seconds": statistics.median(seconds), "mb": tree.memoryUsage() / 1e6, "voxels": tree.size()}


def _points(view: SceneView, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """A view's measurements (N, 3) and its camera (3,) in the world, metres."""
    T = view.T_world_camera
    depth = view.measured_m.astype(np.float64)
    points = (scene.camera.rays() * depth[..., None])[depth > 0]
    return np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3]), np.ascontiguousarray(T[:3, 3])


def measured_methods(contenders: Sequence[Contender]) -> list[str]:
    """Names of what can be timed here."""
    return [each.name for each in contenders] + ([OCTOMAP] if octomap_available() else [])


def scaling_figure(results: Mapping[tuple[float, int, str], Result], methods: Sequence[str]) -> "Figure":
    """Seconds and MB over voxel size, a colour for each method and a line style for each resolution;
    ``results`` by voxel size, stride and method."""
    figure = new_figure(12.0, 4.8)
    left, right = figure.subplots(1, 2)
    _panel(left, results, methods, "seconds", "seconds for a pair")
    _panel(right, results, methods, "mb", "MB of voxels after all pairs")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


def _panel(
    axes: "Axes",
    results: Mapping[tuple[float, int, str], Result],
    methods: Sequence[str],
    what: str,
    label: str,
) -> None:
    sizes = sorted({size for size, _, _ in results})
    for number, method in enumerate(methods):
        for stride, style in zip(STRIDES, ("-", "--", ":"), strict=True):
            values = [results[size, stride, method][what] for size in sizes]
            name = f"{method}, {STRIDES[stride]}"
            axes.plot(sizes, values, "o" + style, color=f"C{number}", markersize=3, label=name)
    axes.set(xscale="log", yscale="log", xlabel="voxel size (m)", ylabel=label, xticks=sizes)
    axes.set_xticklabels([f"{size:g}" for size in sizes])
    axes.minorticks_off()
    axes.grid(alpha=0.3, which="both")
