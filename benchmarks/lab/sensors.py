"""A robot with two sensors in the built-in corridor: maps by its depth camera, by its lidar, and by both.

The camera looks ahead, and a lidar with few rows turns above it. Every keyframe states the noise of its
sensor. The maps are judged by clean views from places in between: what the camera would see there, and views
around.
"""

import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import MRFMap, PolynomialNoise, SphericalCamera, open_dataset
from taichi_mrf.datasets.synthetic.analytic_render import ray_depths
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.tables import Entry, Spread, Table, write_table
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.queries.points import OCCUPIED
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.sensor.simulate import KINECT_1_LATERAL, simulate, simulate_model
from taichi_mrf.system import runtime

SCENE = "synthetic:corridor?rooms=2&frames=80&width=320&height=240&noise=none"

KINECT = replace(KINECT_1_LATERAL, max_depth=4.0)
KINECT_NOISE = PolynomialNoise(KINECT.sigma, KINECT.bias)

LIDAR = SphericalCamera(np.radians(np.linspace(15.0, -15.0, 16)), np.radians(np.arange(0.0, 360.0)))
LIDAR_NOISE = PolynomialNoise((0.02,))
LIDAR_REACH_M = 30.0
LIDAR_OVER_CAMERA_M = 0.3

EVERY, FIRST = 5, 2
"""Every fifth place is held out, from the third on."""

HEADINGS = (0.0, 90.0, 180.0, 270.0)
"""Of the views around, in degrees from that of the robot."""

BY_CAMERA, BY_LIDAR, BY_BOTH, IN_TURN = "camera", "lidar", "both", "both in turn"
"""The maps. The last one takes the camera's image from every second place and the lidar's from the others: as
many images as a sensor alone."""

NEXT = np.array(list(product((-1, 0, 1), repeat=3)))
"""From a voxel to those next to it, and in the middle of the list to itself."""

HALF_GRID = 1 << 19
"""Voxels along an axis from the world's origin that a voxel's number has room for."""


@dataclass(frozen=True)
class _Measured:
    """An image of one sensor, and what is assumed of its noise."""

    depth_m: NDArray[np.float32]
    T_world_camera: Pose
    camera: Camera
    noise: NoiseModel


@dataclass(frozen=True)
class Drive:
    """The camera's image and the lidar's from each place that is mapped, and the clean views that maps are
    judged by: T_world_camera and the depth of ``camera``, (H, W)."""

    camera: Camera
    taken: list[tuple[_Measured, _Measured]]
    ahead: list[tuple[Pose, NDArray[np.float32]]]
    around: list[tuple[Pose, NDArray[np.float32]]]

    def images(self, name: str) -> list[_Measured]:
        """Those of one of the maps, in order."""
        if name == BY_CAMERA:
            return [image for image, _ in self.taken]
        if name == BY_LIDAR:
            return [scan for _, scan in self.taken]
        if name == IN_TURN:
            return [place[number % 2] for number, place in enumerate(self.taken)]
        return [image for place in self.taken for image in place]


def drive(seed: int, limit: int | None = None) -> Drive:
    """Measurements of the robot on its way. Raises ConfigError for fewer places than one that is held out."""
    runtime.init()
    corridor: Any = open_dataset(SCENE, color=False)
    places = range(len(corridor))[:limit]
    held_out = places[FIRST::EVERY]
    if not held_out:
        raise ConfigError(f"{SCENE}: {len(places)} views; the experiment needs at least {FIRST + 1}")
    camera, scene = corridor.camera, corridor.scene
    taken = []
    for i in (i for i in places if i not in held_out):
        T, seen_m = corridor.pose(i), corridor.clean_depth(i)
        image = _Measured(simulate(seen_m, camera, KINECT, seed=(seed, i)), T, camera, KINECT_NOISE)
        T_world_lidar = _lidar_pose(T)
        range_m = ray_depths(scene, LIDAR, T_world_lidar)
        range_m = np.where(range_m <= LIDAR_REACH_M, range_m, np.float32(0))
        range_m = simulate_model(range_m, LIDAR, LIDAR_NOISE, seed=1000 * seed + i)
        taken.append((image, _Measured(range_m, T_world_lidar, LIDAR, LIDAR_NOISE)))
    ahead = [corridor.pose(i) for i in held_out]
    around = [_level(T, degrees) for T in ahead for degrees in HEADINGS]
    clean = ([(T, ray_depths(scene, camera, T)) for T in poses] for poses in (ahead, around))
    return Drive(camera, taken, *clean)


def run_sensors(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """A row for each map and voxel size."""
    seed = experiment.seeds[0]
    robot = drive(seed, experiment.limit)
    places = f"{len(robot.taken)} places, {len(robot.ahead)} held out"
    rows: list[list[Entry]] = []
    for voxel_size in experiment.voxel_sizes:
        names = (BY_CAMERA, BY_LIDAR, BY_BOTH, IN_TURN)
        for number, name in enumerate(names):
            experiment.report(f"{name}, {voxel_size * 100:g} cm", number, len(names))
            key = f"{SCENE} | {places} | noise {seed} | {name} | {voxel_size:g} m"
            result = experiment.ledger.result(key, lambda n=name, v=voxel_size: _judged(robot, n, v))  # type: ignore[misc]
            shares = [
                Spread.of([view[figure] for view in result[views]])
                for figure in ("right", "unanswered")
                for views in ("ahead", "around")
            ]
            rows.append([f"{voxel_size * 100:g} cm", name, *shares, *result["coverage"], result["seconds"]])
    notes = [
        "Shares of the pixels of clean held-out views. Right: the likeliest surface (argmax omega) lies "
        "within 1.5 voxels of the truth; unanswered pixels count as wrong. Ahead: the camera's own views, "
        "around: level views in four directions. Mean and spread over the views.",
        "Covered: share of the voxels holding a surface of these views which the map has occupied; or near: "
        "it or a voxel next to it.",
        f"{places}. Camera: {robot.camera.width} x {robot.camera.height} pixels, Kinect 1 to "
        f"{KINECT.max_depth:g} m. Lidar: {LIDAR.height} x {LIDAR.width} rays, sigma 2 cm, to "
        f"{LIDAR_REACH_M:g} m, {LIDAR_OVER_CAMERA_M * 100:g} cm above the camera. '{IN_TURN}': the camera's "
        "image from every second place, the lidar's from the others.",
    ]
    columns = ["voxels", "map", "right ahead", "right around", "unanswered ahead", "unanswered around"]
    table = Table(
        "sensors", "Two sensors in one map", [*columns, "covered", "or near", "build (s)"], rows, notes
    )
    return [table], write_table(experiment.out, table)


def _lidar_pose(T_world_camera: Pose) -> Pose:
    """T_world_lidar: above the camera, upright, x forward."""
    x, y, _ = T_world_camera[:3, 2] / np.hypot(*T_world_camera[:2, 2])
    T = np.eye(4)
    T[:3, :3] = [[x, -y, 0], [y, x, 0], [0, 0, 1]]
    T[:3, 3] = T_world_camera[:3, 3] + [0, 0, LIDAR_OVER_CAMERA_M]
    return T


def _level(T_world_camera: Pose, degrees: float) -> Pose:
    """A level view from the same place, turned about the vertical."""
    forward, angle = T_world_camera[:3, 2], np.radians(degrees)
    heading = np.arctan2(forward[1], forward[0]) + angle
    eye = T_world_camera[:3, 3]
    return look_at(eye, eye + np.array([np.cos(heading), np.sin(heading), 0.0]))


def _judged(robot: Drive, name: str, voxel_size: float) -> Result:
    start = time.perf_counter()
    m = MRFMap(voxel_size, KINECT_NOISE, max_depth=LIDAR_REACH_M)
    for image in robot.images(name):
        m.add_keyframe(image.depth_m, image.T_world_camera, image.camera, noise=image.noise)
    m.infer()
    result: Result = {"seconds": time.perf_counter() - start, "coverage": _coverage(m, robot)}
    for part, views in (("ahead", robot.ahead), ("around", robot.around)):
        scores = [judge_view(m, true_m, T, robot.camera).accuracy("1.5sigma") for T, true_m in views]
        result[part] = [{"right": score.score, "unanswered": score.unanswered} for score in scores]
    return result


def _coverage(m: MRFMap, robot: Drive) -> list[float]:
    """Shares of the voxels with a visible surface that are occupied, and that are or have a neighbour that
    is."""
    numbers = np.zeros(0, np.int64)
    for T, true_m in (*robot.ahead, *robot.around):
        points = (robot.camera.rays() * true_m[..., None])[true_m > 0] @ T[:3, :3].T + T[:3, 3]
        x, y, z = np.floor(points / m.voxel_size).astype(np.int64).T + HALF_GRID
        numbers = np.union1d(numbers, (x * 2 * HALF_GRID + y) * 2 * HALF_GRID + z)
    voxels = np.stack(np.unravel_index(numbers, (2 * HALF_GRID,) * 3), axis=1) - HALF_GRID
    centers = (voxels + 0.5) * m.voxel_size
    around = [m.state(centers + step * m.voxel_size) == OCCUPIED for step in NEXT]
    return [float(around[len(NEXT) // 2].mean()), float(np.any(around, axis=0).mean())]
