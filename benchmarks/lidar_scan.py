"""Cost of a new scan of a spinning lidar, with and without OctoMap beside it.

    python benchmarks/lidar_scan.py --voxel-size 0.1

Scans of 64 beams and 1024 columns in a hall of 24 x 16 x 5 m with 16 boxes in it, from a sensor that drives
through its middle. Scans are added one by one as a live run does (benchmark/bench.py); medians of the last
ones are printed. OctoMap needs the extra ``octomap``.
"""

import math
from dataclasses import dataclass

import numpy as np
import tyro
from numpy.typing import NDArray

from taichi_mrf import Frame, SphericalCamera
from taichi_mrf.config.schema import Arch, Config, SensorConfig
from taichi_mrf.evaluation.bench import bench_mapping, octomap_available
from taichi_mrf.system import runtime

HALF_M = np.array([12.0, 8.0, 2.5])
"""Half the sizes of the hall."""

SIGMA_M, REACH_M, STEP_M = 0.02, 30.0, 0.25


@dataclass(frozen=True)
class Options:
    """Recording to map."""

    voxel_size: float = 0.1
    """Metres."""

    scans: int = 32
    """Scans, 0.25 m apart."""

    arch: Arch = "auto"
    """Backend."""


def main() -> None:
    """Print the cost of a scan."""
    options = tyro.cli(Options, description=__doc__)
    runtime.init(options.arch)
    lidar = SphericalCamera(
        np.radians(np.linspace(22.5, -22.5, 64)), np.linspace(math.pi, -math.pi, 1025)[:-1]
    )
    sensor = SensorConfig(sigma=(SIGMA_M,), max_depth=REACH_M)
    row = bench_mapping(
        _scans(lidar, options.scans),
        Config(voxel_size=options.voxel_size, sensor=sensor),
        octomap_available(),
    )
    parts = {"adding it": row.allocate, "its own sweep": row.own_sweep, "sweeps of others": row.reinference,
             "added and swept": row.alone, "all of it": row.whole, "OctoMap": row.octomap}  # fmt: skip
    print(f"{row.pixels:,} measurements, {row.rays:,} rays, {row.swept_again:.1f} other scans swept")
    for name, seconds in parts.items():
        if seconds is not None:
            print(f"{name}: {1e3 * seconds.wall:.0f} ms, processor {1e3 * seconds.cpu:.0f} ms")


def _scans(lidar: SphericalCamera, number: int) -> list[Frame]:
    draw = np.random.default_rng(0)
    centres = draw.uniform(-HALF_M, HALF_M, (16, 3))
    centres[:, 1] = np.where(centres[:, 1] < 0, -1, 1) * np.maximum(np.abs(centres[:, 1]), 2.0)
    halves = draw.uniform(0.2, 1.0, (16, 3))
    scans = []
    for i in range(number):
        T_world_lidar = np.eye(4)
        T_world_lidar[:3, 3] = STEP_M * (i - number / 2), 0.1 * math.sin(0.3 * i), -1.0
        range_m = _ranges(T_world_lidar[:3, 3], lidar.rays(), centres, halves)
        range_m += draw.normal(0, SIGMA_M, range_m.shape)
        scans.append(Frame(range_m.astype(np.float32), T_world_lidar, lidar, 0.1 * i, f"scan {i}"))
    return scans


def _ranges(
    origin: NDArray[np.float64],
    rays: NDArray[np.float64],
    centres: NDArray[np.float64],
    halves: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Range (H, W) of the hall's walls, or of the boxes in it, along rays (H, W, 3)."""
    along = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    nearest = ((np.copysign(HALF_M, along) - origin) / along).min(axis=-1)
    for centre, half in zip(centres, halves, strict=True):
        faces = (centre - origin + np.multiply.outer([-1, 1], half)[:, None, None, :]) / along
        enter, leave = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
        nearest = np.where((enter < leave) & (enter > 0), np.minimum(nearest, enter), nearest)
    return nearest


if __name__ == "__main__":
    main()
