"""A spinning lidar in the built-in room that moves half a metre and turns by 30 degrees during each scan."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.analytic_render import ray_depths
from taichi_mrf.datasets.synthetic.room_furniture import camera_pose, room_scene
from taichi_mrf.evaluation.accuracy import judge_view
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import FREE
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.simulate import simulate_model
from taichi_mrf.sensor.spherical import SphericalCamera

MOVED_M, TURNED_RAD = 0.5, math.radians(30.0)
NOISE = PolynomialNoise((0.02,))
VIEW = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
REACH_M = 10.0
POINTS, DEEP_M = 200_000, 0.03

Knowledge = Literal["columns", "points", "nothing"]
"""Maps know a pose for each column, points moved to one centre, or nothing of the motion."""


def lidar(rows: int, columns: int) -> SphericalCamera:
    azimuths = np.linspace(math.pi, -math.pi, columns, endpoint=False)
    return SphericalCamera(np.linspace(0.7, -0.7, rows), azimuths)


def level_pose(phase: float) -> Pose:
    """T_world_lidar at a phase of the path through the room: level, x forward."""
    T_world_camera, T = camera_pose(phase), np.eye(4)
    x, y, _ = T_world_camera[:3, 2] / np.hypot(*T_world_camera[:2, 2])
    T[:3, :3] = [[x, -y, 0], [y, x, 0], [0, 0, 1]]
    T[:3, 3] = T_world_camera[:3, 3]
    return T


def motion(columns: int, moved_m: float = MOVED_M, turned_rad: float = TURNED_RAD) -> NDArray[np.float64]:
    """The poses (W, 4, 4) of the columns in the lidar's frame in the middle of the scan: it moves to the left
    and turns."""
    share = np.linspace(-0.5, 0.5, columns)
    turn = share * turned_rad
    T = np.tile(np.eye(4), (columns, 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(turn)
    T[:, 1, 0], T[:, 0, 1] = np.sin(turn), -np.sin(turn)
    T[:, 1, 3] = share * moved_m
    return T


@dataclass(frozen=True)
class MovingScan:
    """Scan of the lidar at T_world_lidar, the pose in the middle of the scan."""

    T_world_lidar: Pose
    still: SphericalCamera
    moving: RayTable
    range_m: NDArray[np.float32]

    def add_to(self, m: MRFMap, known: Knowledge) -> None:
        if known == "columns":
            m.add_keyframe(self.range_m, self.T_world_lidar, self.moving)
        elif known == "nothing":
            m.add_keyframe(self.range_m, self.T_world_lidar, self.still)
        else:
            points = points_at(self.moving, self.range_m)[self.range_m > 0]
            table, range_m = RayTable.of_points(points)
            m.add_keyframe(range_m, self.T_world_lidar, table)


def scan(number: int, of: int, still: SphericalCamera, moved_m: float = MOVED_M) -> MovingScan:
    """One of several scans along the path. Taichi has to run."""
    T = level_pose((number + 0.2) / of)
    moving = RayTable.moving(still, motion(still.width, moved_m))
    true_m = ray_depths(room_scene(), moving, T)
    return MovingScan(T, still, moving, simulate_model(true_m, moving, NOISE, seed=number))


@dataclass(frozen=True)
class Score:
    """Of clean held-out views: the share of pixels that are right within 1.5 voxels, and the median error in
    metres. Of random points in the map's bricks that lie at least DEEP_M inside a solid: the share that is
    wrongly free."""

    right: float
    median_m: float
    wrongly_free: float


def score(m: MRFMap, views: int) -> Score:
    """Judge a map by level views from the path, to four sides."""
    right, errors = [], []
    for view in range(views):
        eye = camera_pose((view + 0.7) / views)[:3, 3]
        for side in (0.3, 1.9, 3.4, 5.0):
            T = look_at(eye, eye + np.array([math.cos(side), math.sin(side), -0.15]))
            judged = judge_view(m, ray_depths(room_scene(), VIEW, T), T, VIEW)
            right.append(judged.accuracy("1.5sigma").score)
            off = np.abs(judged.answer_m - judged.depth_m)[judged.judged]
            errors.append(np.where(np.isfinite(off), off, np.inf))
    rng = np.random.default_rng(0)
    centres, _ = m.voxels(0.0)
    points = centres[rng.integers(0, len(centres), POINTS)]
    points += rng.uniform(-0.5, 0.5, points.shape) * m.voxel_size
    inside = points[room_scene().signed_distance(points) < -DEEP_M]
    wrongly_free = float(np.mean(m.state(inside) == FREE))
    return Score(float(np.mean(right)), float(np.median(np.concatenate(errors))), wrongly_free)


def mapped(scans: list[MovingScan], known: Knowledge, voxel_size: float) -> MRFMap:
    m = MRFMap(voxel_size, NOISE, max_depth=REACH_M)
    for measured in scans:
        measured.add_to(m, known)
    m.infer()
    return m
