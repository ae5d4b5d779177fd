"""MRFMap's Fig. 10: what another image costs, as the map grows to 30 keyframes.

OctoMap itself gets the same points, a ray for each. MRFMap is timed in both ways of using it: all
keyframes swept three times after each image, as in the paper, and the new keyframe alone.
"""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_mrf import Frame
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.bench import octomap_available, octomap_inserter
from taichi_mrf.evaluation.experiments.contenders import mrf
from taichi_mrf.evaluation.experiments.folds import Experiment, fold_key
from taichi_mrf.evaluation.experiments.scenes import Scene, house_scene
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.evaluation.tables import Table, write_table
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.compiler import ti

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEYFRAMES = 30
FULL_AT = (1, 2, 5, 10, 15, 20, 25, 30)
"""Keyframe counts at which all keyframes are swept, which costs more with each."""

COLORS = {"all keyframes": "tab:blue", "new keyframe": "tab:green", "OctoMap": "tab:red"}


def run_fig10(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Seconds for each image. Raises ConfigError if OctoMap's binding is not installed."""
    if not octomap_available():
        raise ConfigError("fig10 compares with OctoMap: pip install 'taichi-mrf[bench]' adds it")
    scene = house_scene(experiment.data)
    count = min(KEYFRAMES, len(scene.views), experiment.limit or KEYFRAMES)
    timings = {}
    for number, voxel_size in enumerate(experiment.voxel_sizes):
        experiment.report(f"timing {voxel_size * 100:g} cm", number, len(experiment.voxel_sizes))
        timings[voxel_size] = experiment.ledger.result(
            fold_key(scene, 0, mrf(), voxel_size, f"time for each of {count} images"),
            lambda v=voxel_size: _time_images(scene, v, count),  # type: ignore[misc]
        )
    rows = [
        [
            f"{size * 100:g} cm",
            n + 1,
            t["all keyframes"].get(str(n + 1)),
            t["new keyframe"][n],
            t["OctoMap"][n],
        ]
        for size, t in timings.items()
        for n in range(count)
    ]
    table = Table(
        "fig10",
        "Seconds for another image",
        ["voxels", "image", "MRFMap, 3 sweeps over all", "MRFMap, new keyframe", "OctoMap"],
        rows,
        ["house_livingroom, every pixel with a measurement; OctoMap on one thread, as it is."],
    )
    picture = experiment.out / "fig10_curves.png"
    with atomic_path(picture) as temporary:
        _curves(timings).savefig(temporary, dpi=130)
    return [table], [*write_table(experiment.out, table), picture]


def _time_images(scene: Scene, voxel_size: float, count: int) -> dict:
    """Wall time of each way to add each image."""
    warm_up = mrf().make(scene, voxel_size)
    _add(warm_up, scene, 0)
    warm_up.infer()
    m, insert = mrf().make(scene, voxel_size), octomap_inserter(voxel_size)
    full: dict[str, float] = {}
    new, octomap = [], []
    for index in range(count):
        view = scene.views[index]
        start = time.perf_counter()
        k = _add(m, scene, index)
        ti.sync()
        added = time.perf_counter() - start
        if index + 1 in FULL_AT:
            # Before the new keyframe's own sweeps: these would leave it nothing to do.
            start = time.perf_counter()
            m.infer()
            ti.sync()
            full[str(index + 1)] = added + time.perf_counter() - start
            m.remove_keyframe(k)
            k = _add(m, scene, index)
        start = time.perf_counter()
        m.infer(keyframes=[k])
        ti.sync()
        new.append(added + time.perf_counter() - start)
        frame = Frame(view.measured_m, view.T_world_camera, scene.camera, float(index), view.name)
        octomap.append(insert(frame).wall)
    return {"all keyframes": full, "new keyframe": new, "OctoMap": octomap}


def _add(m: OccupancyMap, scene: Scene, index: int) -> int:
    view = scene.views[index]
    return m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name)


def _curves(timings: dict[float, dict]) -> "Figure":
    figure = new_figure(4.2 * len(timings), 4.0)
    for axes, (size, times) in zip(
        figure.subplots(1, len(timings), squeeze=False, sharey=True)[0], timings.items(), strict=True
    ):
        full = times["all keyframes"]
        axes.plot([int(n) for n in full], list(full.values()), "o-", color=COLORS["all keyframes"],
                  label="MRFMap, 3 sweeps over all keyframes")  # fmt: skip
        for name, label in (("new keyframe", "MRFMap, the new keyframe"), ("OctoMap", "OctoMap")):
            axes.plot(range(1, len(times[name]) + 1), times[name], color=COLORS[name], label=label)
        axes.set(yscale="log", xlabel="keyframes", title=f"{size * 100:g} cm voxels")
        axes.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("seconds for another image")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure
