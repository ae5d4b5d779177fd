"""Maps written voxel by voxel, and rays through them in float64, for tests of what reads a map."""

from collections.abc import Callable
from dataclasses import astuple, dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray
from oracles.forward import Noise
from oracles.survey import Profile, Surveyed, profile, survey
from oracles.traversal import clip_to_box, segments

from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology, create_topology

# Written out, and not imported: these tests hold the values.
OPAQUE = 0.001

VOXEL = 0.05
BRICK_M = VOXEL * BRICK
PRIOR = -2.2

CAMERA = PinholeCamera(width=48, height=36, fx=40, fy=42, cx=23.2, cy=17.9)
VIEWS = [
    look_at((0.9, 0.3, -0.1), (-1.2, 2.0, -0.4)),
    look_at((-1.21, 1.93, 3.1), (-1.2, 2.0, 0.0)),
    look_at((-1.3, 2.1, -0.45), (-3.0, 2.5, -0.5)),
]
"""Of the random map: from outside, from above, and from within."""

SQUARE_ON = PinholeCamera(width=1, height=1, fx=100, fy=100, cx=0, cy=0)
"""A single ray along the optical axis."""

THIN = -30.0
"""Log-odds of a voxel that dims nothing."""


@dataclass(frozen=True)
class HandMade:
    """Bricks (n, 3) with their log-odds (n, 8, 8, 8), in a pool and a topology."""

    bricks: NDArray[np.int32]
    log_odds: NDArray[np.float32]
    pool: BrickPool
    topology: Topology

    def at(self, voxels: NDArray[np.int64]) -> NDArray[np.float64]:
        """Log-odds of voxels (n, 3), NaN where no brick is."""
        place = {tuple(brick): i for i, brick in enumerate(self.bricks.tolist())}
        rows = np.array([place.get(tuple(b), -1) for b in (voxels // BRICK).tolist()], np.int64)
        values = self.log_odds[(rows, *(voxels % BRICK).T)].astype(np.float64)
        return np.where(rows >= 0, values, np.nan)


def made(backend: str, bricks: NDArray[np.int32], log_odds: NDArray[np.float32], dead: int = 0) -> HandMade:
    """``dead`` bricks before them have been released again and keep their old values in the pool."""
    pool, topology = BrickPool(PRIOR), create_topology(backend, 64)
    topology.anchor(bricks[0])
    ghosts = pool.allocate(np.zeros((dead, 3), np.int32) + np.arange(dead)[:, None].astype(np.int32))
    slots = pool.allocate(bricks)
    values = pool.belief.to_numpy().reshape(-1, VOXELS)
    values[ghosts] = 8.0
    values[slots] = log_odds.reshape(-1, VOXELS)
    pool.belief.from_numpy(values.reshape(-1))
    pool.owners[slots] = 1
    pool.release(ghosts)
    topology.insert(bricks, slots)
    return HandMade(bricks, log_odds, pool, topology)


def made_at_random(backend: str) -> HandMade:
    """Sixty bricks around (-1, 2, 0) m, mostly thin, with some dense voxels."""
    random = np.random.default_rng(0)
    corner = np.array([-6, 2, -4])
    cells = np.stack(np.unravel_index(random.choice(216, 60, replace=False), (6, 6, 6)), axis=1)
    log_odds = random.normal(-4, 1.5, (60, BRICK, BRICK, BRICK))
    log_odds[random.random(log_odds.shape) < 0.03] = 2.0
    return made(backend, (corner + cells).astype(np.int32), log_odds.astype(np.float32), dead=7)


def row_of_voxels(log_odds: ArrayLike) -> BrickPool:
    """Voxels (n,) in a row along +x from the origin on, the same across the whole of their bricks."""
    row = np.asarray(log_odds, np.float32)
    count = -(-len(row) // BRICK)
    values = np.full(count * BRICK, THIN, np.float32)
    values[: len(row)] = row
    bricks = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(np.int32)
    pool = BrickPool(PRIOR)
    slots = pool.allocate(bricks)
    pool.write("total", slots, np.repeat(values.reshape(count, BRICK), BRICK * BRICK, axis=1))
    pool.owners[slots] = 1
    return pool


def row_pose(camera_x: float) -> Pose:
    """Looks along +x through the middles of the row's voxels, from a place in metres."""
    return look_at((camera_x, 0.175, 0.175), (camera_x + 1.0, 0.175, 0.175))


def profile_of(
    hand: HandMade,
    origin: NDArray,
    direction: NDArray,
    end: float,
    speed: float = 1.0,
    *,
    begin: float = 0.0,
    **occlusion: float,
) -> Profile:
    """The ray from ``begin`` to ``end`` over the voxels that exist. The direction is metres for one unit of
    the ray's parameter, and ``speed`` its length; ``occlusion`` is as in :class:`Occlusion`."""
    cells, near, far = segments(origin / VOXEL, direction / VOXEL, begin, end)
    log_odds = hand.at(cells)
    exists = np.isfinite(log_odds)
    return profile(near[exists], far[exists], log_odds[exists], VOXEL, speed, **occlusion)


def rays_into(hand: HandMade, count: int, seed: int) -> list[tuple[NDArray, NDArray]]:
    """Origins and unit directions, of rays from around the map through it and from inside it."""
    random = np.random.default_rng(seed)
    low, high = hand.bricks.min(axis=0) * BRICK_M, (hand.bricks.max(axis=0) + 1) * BRICK_M
    origins = random.uniform(low - 1.5, high + 1.5, (count, 3))
    directions = random.uniform(low, high, (count, 3)) - origins
    return list(zip(origins, directions / np.linalg.norm(directions, axis=1)[:, None], strict=True))


def surveyed(
    hand: HandMade,
    T_world_camera: Pose,
    max_depth: float,
    measured_m: NDArray,
    noise_at: Callable[[int, int], Noise],
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None,
    **occlusion: float,
) -> Surveyed:
    """The whole view of CAMERA in float64, (H, W) each; ``noise_at`` that of pixel (u, v).

    A pixel without a measurement, 0, is not followed.
    """
    origin, rays = T_world_camera[:3, 3], CAMERA.rays()
    found = np.zeros((len(fields(Surveyed)), *CAMERA.shape))
    for v, u in np.argwhere(measured_m > 0).tolist():
        direction, begin, end = T_world_camera[:3, :3] @ rays[v, u], 0.0, max_depth
        if box is not None:
            begin, end = clip_to_box(origin, direction, begin, end, *box)
        ray = profile_of(
            hand, origin, direction, end, float(np.linalg.norm(direction)), begin=begin, **occlusion
        )
        found[:, v, u] = astuple(survey(ray, OPAQUE, float(measured_m[v, u]), noise_at(u, v)))
    visibility = np.where(measured_m > 0, found[2], 1.0)
    return Surveyed(found[0], found[1], visibility, found[3], found[4], found[5].astype(bool))
