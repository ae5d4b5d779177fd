"""Answers of maps by the defaults of before and of now, side by side: a table for docs/benchmarks.md.

    python benchmarks/defaults.py --data ../shared/data

Before: outliers are next to impossible (``inference.outlier_floor`` 1e-6), rays end in the middle of their
likeliest voxel (omega), and a voxel is occupied if its marginal is over one half. Now: recordings of short
rays have a floor of 0.01, rays end on the measured surface, and the rays' votes say what is occupied. Every
second view makes the map, some of the others judge it, by the truth or, in recordings, by what was measured.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from taichi_mrf import MRFMap, cast_rays, init
from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH
from taichi_mrf.datasets.recorded_noise import SHORT_RAYS_FLOOR
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.experiments.exact import room_scene
from taichi_mrf.experiments.scenes import (
    Scene,
    SceneView,
    coffin_scene,
    house_scene,
    kitchen_scene,
    lidar_scene,
)
from taichi_mrf.experiments.stereo.street import street_scene
from taichi_mrf.queries.view import Answer

STRIDE = 3
"""Every so many-th row and column is judged."""

RARE = 1e-6
"""The density of outliers before, which long rays keep."""


@dataclass(frozen=True)
class Case:
    """A scene, the sizes of its voxels in metres, and what its recording has besides the defaults."""

    name: str
    make: Callable[[Path], Scene]
    voxel_sizes: Sequence[float]
    floor: float = SHORT_RAYS_FLOOR
    pass_through: float = 0.0


CASES = (
    Case("kitchen", lambda data: kitchen_scene(data, 50), (0.05, 0.02)),
    Case("room", lambda data: room_scene(24), (0.05, 0.02)),
    Case("house", lambda data: house_scene(data), (0.05, 0.02)),
    Case("coffin scene, D435", lambda data: coffin_scene(data), (0.05, 0.02)),
    Case("street, stereo", lambda data: street_scene(data, 24), (0.2,), RARE),
    Case("lidar building", lambda data: lidar_scene(data, 40), (0.2,), RARE, LIDAR_PASS_THROUGH),
)


@dataclass(frozen=True)
class Options:
    """Which scenes to map."""

    data: Path
    """The folder of recordings (data/README.md)."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ()
    """Only the scenes whose names begin so."""

    judged: int = 6
    """Views that judge a map, at most."""


def main() -> None:
    """Print a row for each scene and voxel size."""
    options = tyro.cli(Options, description=__doc__)
    init("cpu")
    columns = ("scene", "voxels", "", "1.5 voxels", "5 cm", "log-likelihood", "first occupied voxel")
    print(f"| {' | '.join((*columns, 'map, CPU s', 'answers, CPU s'))} |")
    print("| --- " * 9 + "|")
    answers: tuple[tuple[str, Answer], ...] = ("before", "omega"), ("now", "surface")
    for case in CASES:
        if options.only and not case.name.startswith(options.only):
            continue
        scene = case.make(options.data)
        for voxel_size in case.voxel_sizes:
            for name, by in answers:
                floor = RARE if by == "omega" else case.floor
                figures = measured(scene, case, voxel_size, floor, by, options.judged)
                row = " | ".join(f"{value:.3f}" for value in figures[:4])
                seconds = " | ".join(f"{value:.1f}" for value in figures[4:])
                print(f"| {case.name} | {voxel_size * 100:g} cm | {name} | {row} | {seconds} |", flush=True)


def measured(
    scene: Scene, case: Case, voxel_size: float, floor: float, by: Answer, judged: int
) -> tuple[float, ...]:
    """Shares within 1.5 voxels and 5 cm, log-likelihood, share of rays whose first occupied voxel is right
    within 1.5 voxels, and processor seconds for the map and for its answers."""
    parameters = {"outlier_floor": floor, "pass_through": case.pass_through}
    m = MRFMap(voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, **parameters)
    begin = time.process_time()
    for view in scene.views[::2]:
        m.add_keyframe(
            view.measured_m, view.T_world_camera, view.camera or scene.camera, view.name, sigma_m=view.sigma_m
        )
    m.infer()
    mapped = time.process_time()
    others = scene.views[1::2]
    found = [_judged(m, scene, view, by) for view in others[:: max(1, len(others) // judged)]]
    seconds = mapped - begin, time.process_time() - mapped
    return *np.nanmean(found, axis=0).tolist(), *seconds


def _judged(m: MRFMap, scene: Scene, view: SceneView, by: Answer) -> tuple[float, ...]:
    camera = view.camera or scene.camera
    some = np.zeros(view.true_m.shape, bool)
    some[::STRIDE, ::STRIDE] = True
    seen = judge_view(
        m, view.true_m, view.T_world_camera, camera,
        measured_m=view.measured_m, noise=scene.noise, mask=some & view.judged, by=by,
    )  # fmt: skip
    return (
        seen.accuracy("1.5sigma").score,
        seen.accuracy("5cm").score,
        seen.log_likelihood(),
        _first_occupied(m if by == "surface" else m.layer(), scene, view, seen.judged),
    )


def _first_occupied(m: object, scene: Scene, view: SceneView, judged: np.ndarray) -> float:
    """Share of the rays that meet their first occupied voxel within 1.5 voxels of the depth to judge by."""
    rays = (view.camera or scene.camera).rays()[judged].astype(np.float64)
    R, start = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
    length = np.linalg.norm(rays, axis=1)
    found = cast_rays(m, start, rays @ R.T, 1.5 * scene.max_depth)  # type: ignore[arg-type]
    size = m.voxel_size  # type: ignore[attr-defined]
    depth_m = (found.range + 0.5 * size) / length
    return float(np.mean(found.hit & (np.abs(depth_m - view.true_m[judged]) <= 1.5 * size)))


if __name__ == "__main__":
    main()
