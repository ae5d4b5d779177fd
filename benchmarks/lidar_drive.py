"""Cost of thousands of scans of a spinning lidar: time and memory along a street without end.

    python benchmarks/lidar_drive.py --scans 3000 --voxel-size 0.2 --window-m 40

Scans of 64 beams and 1024 columns, one a metre, with ranges to 50 m, from a car that drives down a street
between houses. The map keeps the keyframes near the car (``volume.window_m``), and what lies further away is
written to a folder. Each row is for the scans since the one before; seconds are medians.
"""

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from taichi_mrf import MRFMap, PolynomialNoise, SphericalCamera
from taichi_mrf.config.schema import Arch, VolumeConfig
from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH, LIDAR_SIGMA_M
from taichi_mrf.datasets.synthetic.analytic_render import ray_depths
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.mapping.selection import surplus
from taichi_mrf.system import runtime
from taichi_mrf.system.memory import peak_memory_mb, reset_peak_memory

REACH_M, STEP_M, EYE_M = 50.0, 1.0, 1.9

BLOCK_M = 18.0
"""Length of the street that has a house and a parked car on either side."""


@dataclass(frozen=True)
class Options:
    """Recording to map."""

    scans: int = 3000
    """Scans, a metre apart."""

    voxel_size: float = 0.2
    """Metres."""

    window_m: float = 40.0
    """Keyframes further from the newest one are frozen, 0 for none; metres."""

    keep: int = 0
    """Keyframes that can still be changed, at most; 0 for all in the window."""

    every: int = 300
    """Scans from one row to the next."""

    arch: Arch = "auto"
    """Backend."""


def main() -> None:
    """Print a row for each part of the drive."""
    options = tyro.cli(Options, description=__doc__)
    runtime.init(options.arch)
    lidar = SphericalCamera(
        np.radians(np.linspace(15.0, -25.0, 64)), np.linspace(math.pi, -math.pi, 1025)[:-1]
    )
    volume = VolumeConfig(window_m=options.window_m)
    noise, passes = PolynomialNoise((LIDAR_SIGMA_M,)), LIDAR_PASS_THROUGH
    m = MRFMap(options.voxel_size, noise, volume=volume, max_depth=REACH_M, pass_through=passes)
    draw = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        parked = Path(folder) / "map_window.zarr"
        if m.window is not None:
            m.window.park_in(parked)
        print("scans  seconds a scan  slowest  keyframes  voxels (million)  map (MB)  peak (MB)  folder (MB)")
        seconds: list[float] = []
        for i in range(options.scans):
            range_m, T_world_lidar = _scan(lidar, i, draw)
            start = time.perf_counter()
            id = m.add_keyframe(range_m, T_world_lidar, lidar, stamp_s=0.1 * i)
            m.renew([id])
            for old in surplus(m, id, options.keep) if options.keep else ():
                m.freeze_keyframe(old)
            seconds.append(time.perf_counter() - start)
            if (i + 1) % options.every == 0 or i + 1 == options.scans:
                size = m.statistics()
                print(
                    f"{i + 1:5d}  {np.median(seconds):14.3f}  {max(seconds):7.3f}  {size.keyframes:9d}"
                    f"  {size.voxels / 1e6:16.1f}  {size.bytes_per_voxel * size.voxels / 1e6:8.0f}"
                    f"  {peak_memory_mb() or math.nan:9.0f}  {_bytes_in(parked) / 1e6:11.0f}",
                    flush=True,
                )
                seconds.clear()
                reset_peak_memory()


def _scan(
    lidar: SphericalCamera, number: int, draw: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Ranges (H, W), 0 where nothing is in reach, and T_world_lidar."""
    x = STEP_M * number
    T_world_lidar = np.eye(4)
    T_world_lidar[:3, 3] = x, 0.3 * math.sin(0.05 * number), EYE_M
    first, last = (math.floor((x + side * REACH_M) / BLOCK_M) for side in (-1, 1))
    ground = Solid("box", (x, 0.0, -0.5), (2 * REACH_M, 2 * REACH_M, 0.5))
    solids = [ground, *(solid for block in range(first, last + 1) for solid in _block(block))]
    true_m = ray_depths(Scene(tuple(solids), (x, 0.0, 50.0)), lidar, T_world_lidar)
    noisy = true_m + draw.normal(0, LIDAR_SIGMA_M, true_m.shape)
    return np.where((true_m > 0) & (true_m < REACH_M), noisy, 0.0).astype(np.float32), T_world_lidar


def _block(number: int) -> list[Solid]:
    """The houses and cars of one block of the street, always the same for the same number."""
    draw = np.random.default_rng([abs(number), number < 0])
    solids = []
    for side in (-1.0, 1.0):
        height, setback, gap = draw.uniform(4.0, 9.0), draw.uniform(8.0, 11.0), draw.uniform(2.0, 6.0)
        x, depth = BLOCK_M * (number + 0.5), 5.0
        half = (0.5 * (BLOCK_M - gap), depth, 0.5 * height)
        solids.append(Solid("box", (x, side * (setback + depth), half[2]), half))
        car = x + draw.uniform(-6.0, 6.0), side * draw.uniform(4.0, 5.0), 0.75
        solids.append(Solid("box", car, (2.1, 0.9, 0.75), yaw=float(draw.normal(0, 0.03))))
    return solids


def _bytes_in(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.exists() else 0


if __name__ == "__main__":
    main()
