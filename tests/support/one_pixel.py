"""Cameras of one pixel, whose maps can be enumerated by brute force."""

from dataclasses import replace

import numpy as np
from oracles import inference as reference

from taichi_mrf.inference.ray_model import AS_PRINTED
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera

VOXEL = 0.1
ONE_PIXEL = PinholeCamera(1, 1, 100.0, 100.0, 0.0, 0.0)
WITH_LENGTHS = replace(AS_PRINTED, segment_lengths=True)


class FineMap(MRFMap):
    """A map with messages in float32."""

    LIMITS = replace(MRFMap.LIMITS, precision="float32")


class ExactMap(MRFMap):
    """A map by the equations as they are printed; ``free_share`` is left to its parameters."""

    LIMITS = AS_PRINTED


class ExactMapWithLengths(MRFMap):
    """The same, but a voxel counts by the length of the ray in it."""

    LIMITS = WITH_LENGTHS


def random_pose(rng: np.random.Generator, reach: float = 2.0) -> np.ndarray:
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q *= np.sign(np.diag(R))
    if np.linalg.det(Q) < 0:
        Q[:, 0] *= -1
    T = np.eye(4)
    T[:3, :3] = Q
    T[:3, 3] = rng.uniform(-reach, reach, 3)
    return T


def look_along(origin: np.ndarray, direction: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A camera whose only pixel looks along ``direction``."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, rng.normal(size=3))
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = origin
    return T


def image(depth: float) -> np.ndarray:
    return np.full((1, 1), depth, np.float32)


def allocated(m: MRFMap) -> set[reference.Voxel]:
    centres, _ = m.voxels(0.0)
    return {tuple(v) for v in np.floor(centres / VOXEL).astype(int).tolist()}


def marginals(m: MRFMap, voxels: list[reference.Voxel]) -> np.ndarray:
    return m.marginals.occupancy((np.array(voxels) + 0.5) * VOXEL).astype(np.float64)


def well_cut(rays: list[reference.Ray], longest: int) -> bool:
    """No corner is grazed (float32 may take the other way round it), and few enough voxels to enumerate."""
    cells = [s for ray in rays for s in ray.segments]
    return all(s.length > 0.02 for s in cells) and all(len(ray.segments) <= longest for ray in rays)
