"""How many balls and paths a second: m.occupied_within and m.path_collision in the built-in room.

    python benchmarks/within_rate.py --voxel-size 0.05

The balls are at random places in the space around the room's walls, free, occupied and unknown. The first
call, in which the kernel is compiled, does not count; the fastest of five is printed.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro

from taichi_mrf import MRFMap, open_dataset
from taichi_mrf.config.schema import Arch
from taichi_mrf.queries.box import map_extent
from taichi_mrf.system import runtime

_TRIES = 5


@dataclass(frozen=True)
class Options:
    """Queries to time."""

    voxel_size: float = 0.05
    """Metres."""

    queries: int = 100_000
    """Balls in a call, and ten times as many as paths."""

    arch: Arch = "auto"
    """Backend."""


def main() -> None:
    """Print the rates."""
    options = tyro.cli(Options, description=__doc__)
    runtime.init(options.arch)
    dataset = open_dataset("synthetic:room?width=320&height=240&frames=8", color=False)
    m = MRFMap(options.voxel_size)
    for index in range(len(dataset)):
        frame = dataset.read(index)
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
    m.infer()
    draw = np.random.default_rng(0)
    points = draw.uniform(*map_extent(m), (options.queries, 3))
    for voxels in (1, 2, 4, 8):
        radius = voxels * options.voxel_size
        rate = options.queries / _fastest(lambda: m.occupied_within(points, radius))  # noqa: B023
        print(f"balls of {voxels} voxels ({radius:g} m): {rate:,.0f} a second")
    starts = points[: options.queries // 10]
    paths = np.stack([starts, starts + draw.normal(size=starts.shape) / np.sqrt(3)], axis=1)
    radius = 4 * options.voxel_size
    rate = len(paths) / _fastest(lambda: m.path_collision(paths, radius))
    print(f"paths of about 1 m, a ball of 4 voxels ({radius:g} m): {rate:,.0f} a second")


def _fastest(call: Callable[[], object]) -> float:
    """Seconds."""
    call()
    times = []
    for _ in range(_TRIES):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


if __name__ == "__main__":
    main()
