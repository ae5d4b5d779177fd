"""Schauwecker & Zell's Figs. 5b and 5c: time and memory against voxel size and image resolution."""

import statistics
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from taichi_mrf.benchmark.bench import octomap_available
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.experiments.contenders import Contender
from taichi_mrf.experiments.ledger import Result
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.experiments.stereo.street import TABLE_I, thinned
from taichi_mrf.system.compiler import ti

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STRIDES: Mapping[int, str] = {1: "full", 2: "half", 4: "quarter"}
OCTOMAP = "OctoMap itself"


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
        "voxels": len(m.voxels(0.0)[0]),
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
