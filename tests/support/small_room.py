"""A small stretch of the built-in room, mapped coarsely: what tests of whole maps share.

As a program it maps the room on a backend of its own and writes the marginals at the probe points,
because Taichi can be started only once in a process: ``python small_room.py cpu out.npy``.
"""

import sys
from collections.abc import Iterable, Mapping
from functools import cache

import numpy as np

from taichi_mrf.datasets import open_dataset
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.brick_map import BrickMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system import runtime

VOXEL_SIZE = 0.08


@cache
def frames() -> list[Frame]:
    """Ten frames around the room."""
    return list(open_dataset("synthetic:room?width=120&height=90&frames=10"))


def add(m: BrickMap, frame: Frame, T_world_camera: Pose | None = None) -> int:
    """Add a frame with what it states itself, at its own pose or at another."""
    T = frame.T_world_camera if T_world_camera is None else T_world_camera
    return m.add_keyframe(frame.depth_m, T, frame.camera, frame.name, **frame.own.arguments())


def build(chosen: Iterable[int | Frame], poses: Mapping[int, Pose] | None = None) -> MRFMap:
    """A map of some of the frames, or of others, fully inferred; ``poses`` replaces some by their numbers."""
    m = MRFMap(VOXEL_SIZE)
    for i in chosen:
        if isinstance(i, Frame):
            add(m, i)
        else:
            add(m, frames()[i], (poses or {}).get(i))
    m.infer()
    return m


def probes() -> np.ndarray:
    """Centres of all voxels in a box around the room."""
    axes = [np.arange(-52, 52), np.arange(-46, 46), np.arange(-24, 24)]
    return (np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) * VOXEL_SIZE


def assert_same_voxels(a: OccupancyMap, b: OccupancyMap) -> None:
    """Equal voxels and equal probabilities, bit for bit, in whatever order they come."""
    (centres, p), (others, q) = a.voxels(0.0), b.voxels(0.0)
    order, other_order = np.lexsort(centres.T), np.lexsort(others.T)
    np.testing.assert_array_equal(centres[order], others[other_order])
    np.testing.assert_array_equal(p[order], q[other_order])


if __name__ == "__main__":
    runtime.init(sys.argv[1])
    np.save(sys.argv[2], build(list(range(5))).occupancy(probes()))
