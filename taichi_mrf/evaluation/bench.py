"""How fast: each stage of mapping a sequence, timed warm, beside OctoMap on the same frames.

The machine's noise is met with medians over keyframes. Both systems get the same points: every pixel
that holds a measurement.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_mrf.config import Config, InferenceConfig
from taichi_mrf.frame import Frame
from taichi_mrf.maps.mrf import MRFMap
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.memory import peak_memory_mb, reset_peak_memory

SWEEPS = InferenceConfig.sweeps
QUERY_POINTS = 100_000


@dataclass(frozen=True)
class BenchRow:
    """One voxel size. Times are medians in seconds for a keyframe, or for a call of a query.

    ``add`` is all that a new keyframe costs: ``allocate``, ``visible`` and ``sweeps``, which are three of
    them over it alone; as nothing else changes between them, the second and third have nothing to do.
    ``sweep`` is a whole one, after other keyframes have changed the beliefs.
    """

    voxel_size: float
    keyframes: int
    rays: int
    allocate: float
    visible: float
    sweeps: float
    add: float
    sweep: float
    octomap: float | None
    occupancy: float
    render_depth: float
    extract: float
    voxel_steps: float
    bricks: int
    voxels: int
    bytes_per_voxel: float
    peak_memory_mb: float | None

    @property
    def add_in_full(self) -> float:
        """What adding a keyframe would cost if each of the three sweeps had to be carried out."""
        return self.allocate + self.visible + SWEEPS * self.sweep

    @property
    def ratio_in_full(self) -> float | None:
        """The same against OctoMap's insertion."""
        return None if self.octomap is None else self.add_in_full / self.octomap

    @property
    def ratio(self) -> float | None:
        """Adding a keyframe, all stages and sweeps, against OctoMap's insertion of the same frame."""
        return None if self.octomap is None else self.add / self.octomap


def octomap_available() -> bool:
    """Whether OctoMap's Python binding (the extra ``bench``) is installed."""
    try:
        import pyoctomap  # noqa: F401
    except ImportError:
        return False
    return True


def bench_mapping(
    frames: Sequence[Frame],
    config: Config,
    with_octomap: bool,
    progress: Callable[[int], None] | None = None,
) -> BenchRow:
    """Map frames one by one as a live map does: allocate, find what is visible, and sweep over the new
    keyframe. ``progress`` is called with the number of frames done."""
    _warm_up(frames[0], config)
    reset_peak_memory()
    begin_mb = peak_memory_mb()
    m = MRFMap.from_config(config, frames[0].camera)
    times: dict[str, list[float]] = {name: [] for name in ("allocate", "visible", "sweeps", "add")}
    octomap_times, rays = [], 0
    octomap = octomap_inserter(config.voxel_size) if with_octomap else None
    for number, frame in enumerate(frames, start=1):
        start = time.perf_counter()
        k = m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
        ti.sync()
        added = time.perf_counter()
        m.infer(sweeps=0, keyframes=[k])
        ti.sync()
        ready = time.perf_counter()
        m.infer(sweeps=SWEEPS, keyframes=[k])
        ti.sync()
        done = time.perf_counter()
        times["allocate"].append(added - start)
        times["visible"].append(ready - added)
        times["sweeps"].append(done - ready)
        times["add"].append(done - start)
        rays += m.keyframes[k].rays
        if octomap is not None:
            octomap_times.append(octomap(frame))
        if progress is not None:
            progress(number)
    # Full inference gives every keyframe a message for every brick that it sees: the most memory, and the
    # time that a sweep takes when all others have changed what this keyframe is told.
    m.infer(sweeps=1)
    sweeps, steps = [], []
    for k in m.keyframes:
        m.infer(sweeps=0, keyframes=[k])
        sweeps.append(_timed(lambda: m.infer(sweeps=1, keyframes=[k])))  # noqa: B023
        steps.append(m.last_voxel_steps)
    peak_mb = None if begin_mb is None else (peak_memory_mb() or 0.0) - begin_mb
    size = m.statistics()
    points = np.random.default_rng(0).choice(m.voxels(0.0)[0], QUERY_POINTS)
    view = frames[len(frames) // 2]
    queries: list[Callable[[], object]] = [
        lambda: m.occupancy(points),
        lambda: m.render_depth(view.camera, view.T_world_camera),
        lambda: m.voxels(0.5),
    ]
    occupancy, render, extract = (_warm_median(query) for query in queries)
    return BenchRow(
        voxel_size=config.voxel_size,
        keyframes=len(frames),
        rays=rays // len(frames),
        allocate=statistics.median(times["allocate"]),
        visible=statistics.median(times["visible"]),
        sweeps=statistics.median(times["sweeps"]),
        sweep=statistics.median(sweeps),
        add=statistics.median(times["add"]),
        octomap=statistics.median(octomap_times) if octomap_times else None,
        occupancy=occupancy,
        render_depth=render,
        extract=extract,
        voxel_steps=statistics.median(steps),
        bricks=size.bricks,
        voxels=size.bricks * VOXELS,
        bytes_per_voxel=size.bytes_per_voxel,
        peak_memory_mb=peak_mb,
    )


def _warm_up(frame: Frame, config: Config) -> None:
    """Compile everything, so that no compilation is timed."""
    m = MRFMap.from_config(config, frame.camera)
    k = m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
    m.infer(sweeps=2, keyframes=[k])
    ti.sync()


def octomap_inserter(voxel_size: float) -> Callable[[Frame], float]:
    """A function that inserts a frame, a ray for each pixel, and returns the seconds that took."""
    import pyoctomap

    tree = pyoctomap.OcTree(voxel_size)

    def insert(frame: Frame) -> float:
        T = frame.T_world_camera
        points = (frame.camera.rays() * frame.depth_m[..., None].astype(np.float64))[frame.depth_m > 0]
        points = np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3])
        origin = np.ascontiguousarray(T[:3, 3])
        # No largest range, no lazy evaluation, no discretised end points: one ray for each point.
        return _timed(lambda: tree.insertPointCloud(points, origin, -1.0, False, False))

    return insert


def _timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    ti.sync()
    return time.perf_counter() - start


def _warm_median(call: Callable[[], object]) -> float:
    call()
    return statistics.median(_timed(call) for _ in range(5))
