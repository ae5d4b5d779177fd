"""`python -m benchmarks.lab early`: held-out rays that enter an occupied voxel before what they measured.

A map that calls too much occupied blocks its robot. Every fifth view is kept out of the map; each of its
measured rays goes to the first occupied voxel, which is too early if it lies more than three standard
deviations and a voxel in front of the measurement. Maps stand beside themselves without the rule for thin
things (inference/thin_matter.py), and beside log-odds. Accuracy is that of answers by the measured surface.
"""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import cast_rays
from taichi_mrf.evaluation.experiments.contenders import Contender, lidar_mrf, log_odds, mrf
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.judging import build, judge_all
from taichi_mrf.evaluation.experiments.scenes import (
    Scene,
    SceneView,
    coffin_scene,
    house_scene,
    kitchen_scene,
    lidar_scene,
    off_the_grid,
)
from taichi_mrf.evaluation.experiments.stereo.street import mrf_of_street, street_scene
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.methods.mrf.decided import Decisions
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import without_bias

BEFORE_SIGMAS = 3.0
"""Standard deviations, and a voxel, in front of a measurement: an occupied voxel there blocks its ray."""

EVERY, FIRST = 5, 2
"""Every fifth view is held out, from the third on."""

SMALL = 4
"""Every fourth pixel of every fourth row makes an image of 160 x 120."""


def run_early(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """A row for each scene, voxel size and map."""
    rows: list[list[Entry]] = []
    kitchen = kitchen_scene(experiment.data, experiment.limit)
    near, far = experiment.voxel_sizes, [4 * size for size in experiment.voxel_sizes]
    ours, by_lidar, by_stereo = (
        replace(each, surface=True) for each in (mrf(ray_density=2.5), lidar_mrf(), mrf_of_street())
    )
    places = [
        ("kitchen", kitchen, ours, near),
        ("kitchen, 160 x 120", _thinned(kitchen), ours, near),
        ("house", house_scene(experiment.data, limit=experiment.limit), ours, near),
        ("coffin scene", off_the_grid(coffin_scene(experiment.data)), ours, near),
        (
            "building by lidar",
            lidar_scene(experiment.data, experiment.limit),
            by_lidar,
            far,
        ),
        (
            "street by stereo",
            street_scene(experiment.data, experiment.limit),
            by_stereo,
            far,
        ),
    ]
    for name, scene, contender, sizes in places:
        if not experiment.wants(name):
            continue
        for size in sizes:
            for label, maker, without in (
                ("MRFMap", contender, False),
                ("MRFMap without the rule", contender, True),
                ("log-odds", log_odds("log-odds"), False),
            ):
                experiment.report(f"{name}, {label}, {100 * size:g} cm", 0, 1)
                row = _row(maker, scene, size, without)
                rows.append([name, f"{100 * size:g} cm", label, *row])
                print(*rows[-1], flush=True)
    columns = ["scene", "voxels", "map", "too early", "first is right", "none", "right", "log-likelihood"]
    notes = [
        "First is right: the ray's first occupied voxel lies within 1.5 voxels of the measurement. Right and "
        "log-likelihood are of answers by the measured surface, and for log-odds by the likeliest voxel.",
    ]
    table = Table("early", "Rays that enter an occupied voxel too early", columns, rows, notes)
    return [table], write_table(experiment.out, table)


def too_early(
    m: OccupancyMap, frame: Frame, sigma_m: NDArray[np.floating]
) -> tuple[NDArray[np.bool_], NDArray[np.floating]]:
    """Of a frame's measured rays (n,), with the standard deviation of each pixel (H, W): whether they enter
    an occupied voxel too early, and by how many metres of depth the first one lies in front of the
    measurement (NaN where there is none)."""
    seen = frame.depth_m > 0
    rays = frame.camera.rays()[seen] @ frame.T_world_camera[:3, :3].T
    length, measured_m = np.linalg.norm(rays, axis=1), frame.depth_m[seen].astype(float)
    hits = cast_rays(m, frame.T_world_camera[:3, 3], rays, float((measured_m * length).max()))
    before_m = np.where(hits.hit, measured_m - hits.range / length, np.nan)
    return hits.hit & (before_m > BEFORE_SIGMAS * sigma_m[seen] + m.voxel_size), before_m


def _row(contender: Contender, scene: Scene, size: float, without: bool) -> list[Entry]:
    held_out = range(FIRST, len(scene.views), EVERY)
    keyframes = [i for i in range(len(scene.views)) if i not in held_out]
    with patch.object(Decisions, "call_matter", _nothing) if without else nullcontext():
        m, seconds = build(contender, scene, size, keyframes)
        found = [_first_occupied(m, scene, scene.views[i]) for i in held_out]
    readings = judge_all(m, seconds, contender, scene, held_out)["readings"]
    judged = list(readings["" if contender.surface else "occupied leaves"].values())
    accuracy = [float(np.mean([view[name] for view in judged])) for name in ("1.5sigma", "log_likelihood")]
    return [*np.mean(found, axis=0).tolist(), *accuracy]


def _first_occupied(m: OccupancyMap, scene: Scene, view: SceneView) -> list[float]:
    """Shares of a view's rays: too early, right, without an occupied voxel."""
    camera = view.camera or scene.camera
    depth_m = np.where(view.judged, view.measured_m, 0).astype(np.float32)
    noise = scene.noise.table(camera)
    sigma_m = view.sigma_m if view.sigma_m is not None else noise.at_pixels(depth_m)[0]
    depth_m = without_bias(depth_m, noise).astype(np.float32)
    frame = Frame(depth_m, view.T_world_camera, camera, 0.0, view.name)
    early, before_m = too_early(m, frame, sigma_m)
    right = np.abs(before_m) <= 1.5 * m.voxel_size
    return [float(np.mean(each)) for each in (early, right, np.isnan(before_m))]


def _nothing(decisions: Decisions, log_odds: object) -> None:
    """In place of the rule."""


def _thinned(scene: Scene) -> Scene:
    K, step = scene.pinhole, SMALL
    camera = PinholeCamera(
        K.width // step, K.height // step, K.fx / step, K.fy / step, K.cx / step, K.cy / step
    )
    views = [
        replace(
            view,
            measured_m=np.ascontiguousarray(view.measured_m[::step, ::step]),
            true_m=np.ascontiguousarray(view.true_m[::step, ::step]),
            judged=np.ascontiguousarray(view.judged[::step, ::step]),
        )
        for view in scene.views
    ]
    return replace(scene, name=f"{scene.name}, 160 x 120", camera=camera, views=views)
