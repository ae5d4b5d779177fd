"""A walk through the built-in room as a camera without poses sees it: what tests of tracking share."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from inputs_frames import Frames, of_frames
from numpy.typing import NDArray

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.sensor.frame import Frame

CONFIG = Config(voxel_size=0.05, evaluation=EvaluationConfig(hold_out=0))
COUNT = 24
START = np.eye(4)
"""Start that the walk is taken to have; it does not say where in the room that is."""


@cache
def frames() -> list[Frame]:
    """A quarter of the way around the room: 8 cm and 4 degrees from one image to the next, as of a camera
    that is carried about at 10 images a second, with a Kinect 1's noise."""
    dataset = open_dataset("synthetic:room?frames=100&width=160&height=120", color=False)
    return [replace(dataset.read(i), stamp=i / 10) for i in range(COUNT)]


@cache
def coarse_frames() -> list[Frame]:
    """Eight frames of a third of the way round the room."""
    dataset = open_dataset("synthetic:room?width=160&height=120&frames=20", color=False)
    return [dataset.read(i) for i in range(8)]


def disturbed(count: int, seed: int) -> list[Pose]:
    """Poses of coarse frames, all but the first off by 2 cm and a degree along and about each axis."""
    random, scale = np.random.default_rng(seed), np.repeat([0.02, np.radians(1.0)], 3)
    true = [frame.T_world_camera for frame in coarse_frames()[:count]]
    return [true[0], *(moved(T, random.normal(0, scale)) for T in true[1:])]


def walk(
    order: Sequence[int] = tuple(range(COUNT)), shown: Mapping[int, NDArray[np.float32]] | None = None
) -> Frames:
    """The walk. ``shown`` are the depth images that stand in for some, by index."""
    images = {i: frames()[number].depth_m for i, number in enumerate(order)} | dict(shown or {})
    camera = frames()[0].camera
    walked = [Frame(images[i], START, camera, i / 10, f"walk-{i:03d}") for i in range(len(order))]
    return of_frames(walked, "walk", tracked=True)


def true_pose(index: int) -> Pose:
    """Pose of a frame, as seen from the first."""
    return np.linalg.inv(frames()[0].T_world_camera) @ frames()[index].T_world_camera


def errors(poses: Mapping[int, Pose], order: Sequence[int] = tuple(range(COUNT))) -> NDArray[np.float64]:
    """(N, 2): how far each pose is off, in radians and metres."""
    return np.array([tangent_norms(true_pose(order[i]), T) for i, T in poses.items()])


def nowhere() -> NDArray[np.float32]:
    """An image of another place: a slanted wall, near by."""
    rows, columns = np.mgrid[: frames()[0].camera.height, : frames()[0].camera.width]
    return (0.7 + 0.002 * columns + 0.001 * rows).astype(np.float32)
