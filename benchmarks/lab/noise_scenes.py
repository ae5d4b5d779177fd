"""Recordings whose noise file is right, and such where it is not: those that `benchmarks.lab noise` maps.

Real ones have poses that are off and errors that neighbouring pixels share, which no noise file holds.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf import PolynomialNoise, open_dataset
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.evaluation.experiments.contenders import Contender, lidar_mrf, mrf
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.scenes import (
    Scene,
    SceneView,
    coffin_scene,
    house_scene,
    kitchen_scene,
    lidar_scene,
)
from taichi_mrf.evaluation.experiments.stereo.street import street_scene, thinned
from taichi_mrf.sensor.simulate import SimulatedSensor, simulate

STEREO_SIGMA = (0.0, 0.0, 0.00075291)
"""That of configs/stereo.yaml."""

KINECT_ONE_SIGMA = (0.0015, -0.0005, 0.0003)
"""That of configs/kinect_one.yaml."""

TOF = SimulatedSensor(
    sigma=(0.006, 0.0, 0.0015), steep_sigma=0.0005, lateral_sigma_px=0.8, largest_jump=0.5, max_depth=6.0
)
"""A small time-of-flight camera, which sees through edges: pixels beside them keep a depth."""

AS_MAPPED = partial(mrf, ray_density=2.5)
"""MRFMap with the default number of rays, as `map` has it, in place of a ray for each pixel."""

TOF_WALK = "synthetic:corridor?rooms=2&frames=60&width=320&height=240&noise=none"
TOF_WAVE_M, TOF_WAVE_PIXELS = 0.01, 25.0
"""Standard deviation of the errors that neighbouring pixels share, and how far they reach."""
TOF_POSE_M, TOF_POSE_RAD = 0.005, 0.003
"""Standard deviation of recorded poses along and about each axis."""


@dataclass(frozen=True)
class NoiseCase:
    """A recording with a noise file: ``right`` if that is the sensor's. Views that are not ``held_out`` are
    mapped; ``ours`` is MRFMap for this kind of sensor, by name and parameters."""

    name: str
    voxel_sizes: tuple[float, ...]
    right: bool
    take: Callable[[Experiment], Scene]
    held_out: slice
    ours: Callable[..., Contender] = AS_MAPPED

    def split(self, scene: Scene) -> tuple[list[int], list[int]]:
        """Indices of the mapped and of the held-out views."""
        held_out = list(range(len(scene.views)))[self.held_out]
        return [i for i in range(len(scene.views)) if i not in held_out], held_out


def cases() -> list[NoiseCase]:
    """All recordings."""
    every_other, every_fifth = slice(1, None, 2), slice(2, None, 5)
    return [
        NoiseCase(
            "kitchen", (0.05, 0.02, 0.01), False, lambda e: kitchen_scene(e.data, e.limit), every_other
        ),
        NoiseCase("street", (0.2,), False, _street, every_other),
        NoiseCase("time of flight", (0.05,), False, _time_of_flight, every_fifth),
        NoiseCase("building", (0.2,), False, lambda e: lidar_scene(e.data, e.limit), every_fifth, lidar_mrf),
        NoiseCase("house", (0.05, 0.02), True, lambda e: house_scene(e.data, 0, e.limit), every_other),
        NoiseCase("room", (0.05, 0.02), True, _room, every_fifth),
        NoiseCase("coffin", (0.05,), True, lambda e: coffin_scene(e.data), slice(2, None, 4)),
    ]


def _street(experiment: Experiment) -> Scene:
    return replace(
        thinned(street_scene(experiment.data, experiment.limit), 2), noise=PolynomialNoise(STEREO_SIGMA)
    )


def _room(experiment: Experiment) -> Scene:
    return _rendered("room", open_dataset("synthetic:room"), experiment.limit)


def _rendered(name: str, dataset: Dataset, limit: int | None) -> Scene:
    frames = [dataset.read(i) for i in range(len(dataset))[:limit]]
    views = [SceneView(f.name, f.T_world_camera, f.depth_m, f.depth_m, f.depth_m > 0) for f in frames]
    return Scene(name, dataset.camera, PolynomialNoise(SimulatedSensor().sigma), VolumeConfig(), 10.0, views)


def _time_of_flight(experiment: Experiment) -> Scene:
    """A corridor by a time-of-flight camera, with the noise file of a better one, and poses that are off."""
    corridor: Any = open_dataset(TOF_WALK, color=False)
    views = []
    for i in range(len(corridor))[: experiment.limit]:
        random = np.random.default_rng((7, i))
        measured_m = simulate(corridor.clean_depth(i), corridor.camera, TOF, seed=(8, i))
        measured_m = np.where(measured_m > 0, measured_m + _wave(random, measured_m.shape), 0).astype(
            np.float32
        )
        twist = np.repeat([TOF_POSE_M, TOF_POSE_RAD], 3) * random.standard_normal(6)
        T_recorded = moved(corridor.pose(i), twist)
        views.append(SceneView(f"view {i}", T_recorded, measured_m, measured_m, measured_m > 0))
    noise = PolynomialNoise(KINECT_ONE_SIGMA)
    return Scene("time of flight", corridor.camera, noise, VolumeConfig(), 8.0, views)


def _wave(random: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Errors (H, W) in metres that vary slowly over an image."""
    field = cv2.GaussianBlur(random.standard_normal(shape), (0, 0), TOF_WAVE_PIXELS)
    return np.asarray(field * (TOF_WAVE_M / field.std()))
