"""A wall that no voxel of a map is sure of."""

import numpy as np
from one_pixel import VOXEL

from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

WALL_M = 2.02


def uncertain_wall(keyframes: int = 2) -> MRFMap:
    """A wall across the z axis, seen with a sigma of two voxels."""
    m = MRFMap(VOXEL, PolynomialNoise((0.2,)))
    camera = PinholeCamera(24, 16, 20.0, 20.0, 11.5, 7.5)
    rng = np.random.default_rng(3)
    for i in range(keyframes):
        T = np.eye(4)
        T[:3, 3] = [0.013 + 0.3 * i, 0.017, 0.0]
        m.add_keyframe(rng.normal(WALL_M, 0.2, camera.shape).astype(np.float32), T, camera)
    m.infer()
    return m
