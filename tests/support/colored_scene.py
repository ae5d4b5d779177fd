"""A red thing in front of a blue wall, in depth and colour: what tests of colours look at."""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

CAMERA = PinholeCamera(48, 36, 40.0, 40.0, 23.5, 17.5)
VOXEL = 0.05
NOISE = PolynomialNoise((0.02,))
WALL_Z, THING_Z, HALF = 2.02, 1.32, 0.22
RED, BLUE = np.array([230, 20, 40], np.uint8), np.array([30, 60, 210], np.uint8)


def pose(x: float, y: float = 0.0) -> Pose:
    """A camera at (x, y, 0) that looks along z."""
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def view(x: float, y: float = 0.0, seed: int | None = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth and colour from there, with the sensor's noise unless ``seed`` is None."""
    rays = CAMERA.rays()
    on_thing = np.abs(rays[..., 0] * THING_Z + x) < HALF
    on_thing &= np.abs(rays[..., 1] * THING_Z + y) < HALF
    depth = np.where(on_thing, THING_Z, WALL_Z)
    if seed is not None:
        depth = depth + np.random.default_rng(seed).normal(0.0, 0.02, depth.shape)
    return depth.astype(np.float32), np.where(on_thing[..., None], RED, BLUE)


PLACES = [(-0.3, 0.0), (-0.1, 0.1), (0.0, -0.1), (0.1, 0.0), (0.3, 0.05), (0.2, -0.05)]


def add(m: MRFMap, number: int, place: int | None = None) -> int:
    """Add a view, at the pose where it was taken or at that of another."""
    depth, color = view(*PLACES[number], seed=number)
    T = pose(*PLACES[number if place is None else place])
    return m.add_keyframe(depth, T, CAMERA, f"view {number}", color=color)


def build(numbers: list[int]) -> MRFMap:
    """A map of some of the views, inferred."""
    m = MRFMap(VOXEL, NOISE)
    for number in numbers:
        add(m, number)
    m.infer()
    return m


HISTORIES = st.lists(
    st.tuples(st.sampled_from(["add", "remove", "move", "infer", "look"]), st.integers(0, 5)), max_size=8
)
"""What was done to a map, each with a number that chooses a view."""

FINAL = st.permutations(range(6)).map(lambda order: order[:3])
"""The views of which a map is in the end."""


def edited(
    history: list[tuple[str, int]],
    final: list[int],
    look: Callable[[MRFMap], object],
    add: Callable[[MRFMap, int], int] = add,
) -> MRFMap:
    """A map with a history, which ends with the ``final`` views alone, inferred; ``look`` reads the layer."""
    m = MRFMap(VOXEL, NOISE)
    for verb, number in history:
        ids = list(m.keyframes)
        if verb == "add" and len(ids) < 4:
            add(m, number)
        elif verb == "remove" and ids:
            m.remove_keyframe(ids[number % len(ids)])
        elif verb == "move" and ids:
            m.move_keyframe(ids[number % len(ids)], pose(*PLACES[number]))
        elif verb == "infer":
            m.infer(sweeps=1)
        elif verb == "look":
            look(m)
    for id in list(m.keyframes):
        m.remove_keyframe(id)
    for number in final:
        add(m, number)
    m.infer()
    return m


def probes() -> NDArray[np.float64]:
    """Centres of all voxels around the scene."""
    axes = [np.arange(-40, 40), np.arange(-30, 30), np.arange(16, 52)]
    return (np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) * VOXEL
