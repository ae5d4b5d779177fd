"""Cameras of one pixel, whose maps can be enumerated by brute force."""

from dataclasses import replace

import numpy as np
from hypothesis import assume
from oracles import inference as reference
from oracles.forward import Noise

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.ray_model import AS_PRINTED
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick

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


def crossing(
    seed: int, depths: tuple[float, ...], sigma: float, prior: float
) -> tuple[MRFMap, list[reference.Ray], InferenceConfig]:
    """Keyframes of one ray each, which meet in one voxel, and the rays of the oracle."""
    rng = np.random.default_rng(seed)
    shared = (rng.integers(-20, 20, 3) + rng.uniform(0.2, 0.8, 3)) * VOXEL
    config = InferenceConfig(prior=prior, free_share=0.0)
    poses, rays = [], []
    for depth in depths:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        poses.append(look_along(shared - direction * rng.uniform(0.05, 0.3), direction, rng))
        rays += reference.cast(image(depth), poses[-1], ONE_PIXEL, VOXEL, Noise((sigma,)), max_depth=0.4)
    assume(well_cut(rays, 9))
    m = ExactMap(VOXEL, PolynomialNoise((sigma,)), inference=config, max_depth=0.4)
    for depth, T in zip(depths, poses, strict=True):
        m.add_keyframe(image(depth), T, ONE_PIXEL)
    assume({s.voxel for ray in rays for s in ray.segments} <= allocated(m))
    return m, rays, config


def cavities(m: MRFMap, k: Keyframe) -> dict[reference.Voxel, float]:
    """Log-odds of the voxels that a keyframe sees, without its own messages."""
    bricks = k.footprint.window.bricks_of(k.visible.cells)
    voxels = (bricks[:, None] * BRICK + offsets_in_brick()).reshape(-1, 3)
    belief = m.view.pool.read("belief", k.visible.slots).reshape(-1).astype(np.float64)
    assert k.messages is not None
    found = belief - k.messages.to_numpy()[: len(belief)].astype(np.float64)
    return dict(zip(map(tuple, voxels.tolist()), found.tolist(), strict=True))


def spread(ray: reference.Ray, cavity: dict, config: InferenceConfig, prior: float) -> dict:
    """The posterior of each voxel of a ray that it is what the pixel sees."""
    lowest = reference.logit(config.free_share * prior)
    visibility, found = 1.0, {}
    for segment, density in zip(ray.segments, ray.densities, strict=True):
        if segment.voxel in cavity:
            m = reference.logistic(min(FineMap.LIMITS.cavity, max(lowest, cavity[segment.voxel])))
            free = (1 - m) ** segment.length
            found[segment.voxel] = (1 - free) * density * visibility
            visibility *= free
    total = sum(found.values()) + visibility * ray.beyond + config.floor
    return {voxel: here / total for voxel, here in found.items()}
