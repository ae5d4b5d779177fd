"""Speed: the cost of a keyframe in a live map in its steady state, beside OctoMap on the same frames.

The first frames fill the map and warm everything up; the last ones are measured. The machine's noise is met
with medians over keyframes. Both systems get the same points: every pixel that holds a measurement.
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from taichi_mrf import Config, Frame, MRFMap
from taichi_mrf.evaluation.keyframe_cost import KeyframeCost, Seconds, add_timed, timed, warm_up
from taichi_mrf.system.memory import peak_memory_mb, reset_peak_memory
from taichi_mrf.voxels.layout import VOXELS

STEADY_FRAMES = 10
"""The last so many keyframes are measured, but never more than a quarter of all, and at least one."""

QUERY_POINTS = 100_000

TARGETS = {0.05: (0.15, 0.5), 0.02: (0.1, 0.3), 0.01: (0.05, 0.1)}
"""Largest share of OctoMap's time that a keyframe should take, without re-inference and with it, by voxel
size in metres; on two CPU cores, with 30 keyframes in the map."""

Advance = Callable[[int], object]
"""Called with the number of frames done."""


@dataclass(frozen=True)
class BenchRow:
    """One voxel size. Durations are medians over the steady state's keyframes, or over calls of a query.

    ``alone`` is ``allocate`` and ``own_sweep``, ``whole`` has the re-inference of others in it, whose median
    may hide that only some keyframes cause it: ``whole_mean`` does not. ``full_sweep`` is a sweep over one
    keyframe after full inference. ``pixels`` hold a measurement, ``rays`` are cast for them.
    """

    voxel_size: float
    keyframes: int
    steady: int
    pixels: int
    rays: int
    allocate: Seconds
    own_sweep: Seconds
    reinference: Seconds
    swept_again: float
    alone: Seconds
    whole: Seconds
    whole_mean: Seconds
    octomap: Seconds | None
    full_sweep: Seconds
    voxel_steps: float
    occupancy: Seconds
    render_depth: Seconds
    extract: Seconds
    bricks: int
    voxels: int
    bytes_per_voxel: float
    peak_memory_mb: float | None

    @property
    def ratio_alone(self) -> float | None:
        """Without re-inference, against OctoMap's insertion of the same frames."""
        return None if self.octomap is None else self.alone.wall / self.octomap.wall

    @property
    def ratio_whole(self) -> float | None:
        """The whole cost against the same."""
        return None if self.octomap is None else self.whole.wall / self.octomap.wall

    @property
    def targets(self) -> tuple[float, float] | None:
        """Upper limits of these two, where they have been laid down."""
        return TARGETS.get(round(self.voxel_size, 6))

    def to_json(self) -> dict[str, Any]:
        """All figures under their names, with the ratios and their targets."""
        alone, whole = self.targets or (None, None)
        ratios = {"ratio_alone": self.ratio_alone, "ratio_whole": self.ratio_whole}
        if self.octomap is not None:
            ratios["cpu_ratio_alone"] = self.alone.cpu / self.octomap.cpu
            ratios["cpu_ratio_whole"] = self.whole.cpu / self.octomap.cpu
        return asdict(self) | ratios | {"target_alone": alone, "target_whole": whole}


def bench_mapping(
    frames: Sequence[Frame], config: Config, with_octomap: bool, progress: Advance | None = None
) -> BenchRow:
    """Map frames one by one as a live run does, and time the last of them."""
    steady = max(1, min(STEADY_FRAMES, len(frames) // 4))
    warm_up(MRFMap.from_config(config, frames[0].camera), frames)
    reset_peak_memory()
    begin_mb = peak_memory_mb()
    m = MRFMap.from_config(config, frames[0].camera)
    costs: list[KeyframeCost] = []
    for number, frame in enumerate(frames, start=1):
        costs.append(add_timed(m, frame))
        if progress is not None:
            progress(number)
    costs = costs[-steady:]
    # Full inference gives every keyframe a message for every brick that it sees: the most memory.
    m.infer(sweeps=1)
    sweeps, steps = [], []
    last = [m.keyframes[id] for id in sorted(m.keyframes)[-steady:]]
    # the keyframe that was swept last has nothing new to send
    m.infer(sweeps=1, keyframes=[min(m.keyframes)])
    for keyframe in last:
        sweeps.append(timed(lambda: m.infer(sweeps=1, keyframes=[keyframe.id])))  # noqa: B023
        steps.append(m.last_voxel_steps)
    peak_mb = None if begin_mb is None else (peak_memory_mb() or 0.0) - begin_mb
    octomap_times: list[Seconds] = []
    if with_octomap:  # after the other, as each would run by itself, with its own memory in the caches
        octomap = octomap_inserter(config.voxel_size)
        octomap_times = [octomap(frame) for frame in frames][-steady:]
    size = m.statistics()
    points = np.random.default_rng(0).choice(m.voxels(0.0)[0], QUERY_POINTS)
    view = frames[len(frames) // 2]
    return BenchRow(
        voxel_size=config.voxel_size,
        keyframes=len(frames),
        steady=steady,
        pixels=round(statistics.mean(k.rays for k in last)),
        rays=round(statistics.mean(k.ray_list.number for k in last)),
        allocate=Seconds.median([c.allocate for c in costs]),
        own_sweep=Seconds.median([c.own_sweep for c in costs]),
        reinference=Seconds.median([c.reinference for c in costs]),
        swept_again=statistics.mean(c.swept_again for c in costs),
        alone=Seconds.median([c.alone for c in costs]),
        whole=Seconds.median([c.whole for c in costs]),
        whole_mean=Seconds.mean([c.whole for c in costs]),
        octomap=Seconds.median(octomap_times) if octomap_times else None,
        full_sweep=Seconds.median(sweeps),
        voxel_steps=statistics.median(steps),
        occupancy=_warm_median(lambda: m.occupancy(points)),
        render_depth=_warm_median(lambda: m.render_depth(view.camera, view.T_world_camera)),
        extract=_warm_median(lambda: m.voxels(0.5)),
        bricks=size.bricks,
        voxels=size.bricks * VOXELS,
        bytes_per_voxel=size.bytes_per_voxel,
        peak_memory_mb=peak_mb,
    )


def octomap_available() -> bool:
    """True if OctoMap's Python binding (the extra ``bench``) is installed."""
    try:
        import pyoctomap  # noqa: F401
    except ImportError:
        return False
    return True


def octomap_inserter(voxel_size: float) -> Callable[[Frame], Seconds]:
    """A function that inserts a frame, a ray for each pixel, and returns how long that took."""
    import pyoctomap

    tree = pyoctomap.OcTree(voxel_size)

    def insert(frame: Frame) -> Seconds:
        T = frame.T_world_camera
        points = frame.points_m[frame.depth_m > 0]
        points = np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3])
        origin = np.ascontiguousarray(T[:3, 3])
        # No largest range, no lazy evaluation, no discretised end points: one ray for each point.
        return timed(lambda: tree.insertPointCloud(points, origin, -1.0, False, False))

    return insert


def _warm_median(call: Callable[[], object]) -> Seconds:
    call()
    return Seconds.median([timed(call) for _ in range(5)])
