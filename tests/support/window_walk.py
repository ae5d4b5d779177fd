"""A camera that walks to and fro along a wall without end, mapped with a window and without one."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from sliding_camera import CAMERA, WALL_M

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.voxels.layout import CHUNK_VOXELS

VOXEL = 0.05
CHUNK_M = CHUNK_VOXELS * VOXEL
WINDOW_M = 1.0

OUT = [0.5 * step for step in range(13)]
"""Places on the way out, metres: almost two chunks."""


def windowed(folder: Path | None = None, window_m: float = WINDOW_M, **options: Any) -> MRFMap:
    """An empty map with a window, which parks in a folder."""
    m = MRFMap(VOXEL, volume=VolumeConfig(window_m=window_m, dense_bricks=128), **options)
    if folder is not None:
        assert m.window is not None
        m.window.park_in(folder)
    return m


def unwindowed(**options: Any) -> MRFMap:
    """An empty map that is in memory as a whole."""
    return MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128), **options)


def add(
    m: MRFMap, place_m: float, number: int = 0, colored: bool = False, stamp_s: float | None = None
) -> int:
    """A keyframe ``place_m`` along the wall, with noise that depends on place and ``number``, perhaps with a
    colour image and a stamp."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = place_m, 0.013, 0.021
    random = np.random.default_rng((int(place_m * 1000) + 10**6, number))
    depth_m = (WALL_M + random.normal(0.0, 0.004, CAMERA.shape)).astype(np.float32)
    color = random.integers(1, 256, (*CAMERA.shape, 3)).astype(np.uint8) if colored else None
    name = f"{place_m:g} m, {number}"
    return m.add_keyframe(depth_m, T_world_camera, CAMERA, name, stamp_s, color=color)


def walk(m: MRFMap, places_m: Iterable[float], colored: bool = False) -> list[int]:
    """Add keyframes and sweep each; returns how many bricks were in memory after each."""
    bricks = []
    for number, place_m in enumerate(places_m):
        m.renew([add(m, place_m, number, colored)])
        bricks.append(m.statistics().bricks)
    return bricks


def walk_both(m: MRFMap, other: MRFMap, places_m: Iterable[float], colored: bool = False) -> None:
    """One walk in a map with a window and in one without, which freezes the same keyframes when the
    first does."""
    for number, place_m in enumerate(places_m):
        here, there = add(m, place_m, number, colored), add(other, place_m, number, colored)
        for id in m.frozen.keys() & other.keyframes.keys():
            other.freeze_keyframe(id)
        m.renew([here])
        other.renew([there])


def probes(m: MRFMap) -> np.ndarray:
    """All voxels of a map, places between the camera and the wall, and places where nothing is."""
    centres, _ = m.voxels(0.0)
    along = np.linspace(centres[:, 0].min() - 1, centres[:, 0].max() + 1, 400)
    depths = [np.stack([along, np.full(400, 0.02), np.full(400, z)], axis=1) for z in (-0.5, 0.4, 0.9, 3.0)]
    return np.concatenate([centres, *depths])
