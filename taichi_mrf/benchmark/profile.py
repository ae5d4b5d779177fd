"""Profile of a new keyframe: every kernel by Taichi's own profiler, and the host by Python's.

Taichi has to be started with ``runtime.init(profile=True)``. On Vulkan, where its profiler does not work with
so many kernels, launches are timed instead (launches.py), which has a launch's own cost in it. Profiling
slows the host down. bench.py measures what a keyframe costs; this divides that cost among kernels and host.
"""

import cProfile
import pstats
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import taichi_mrf
from taichi_mrf import Config, Frame, MRFMap
from taichi_mrf.benchmark.kernel_floors import FLOORS, Work
from taichi_mrf.benchmark.keyframe_cost import live_stages, timed, warm_up
from taichi_mrf.benchmark.launches import count_launches
from taichi_mrf.kernels import quick_start
from taichi_mrf.system import compiler, runtime
from taichi_mrf.system.compiler import ti

PACKAGE = str(Path(taichi_mrf.__file__).parent)
TAICHI = str(Path(ti.__file__).parent)
WATCH = count_launches.__wrapped__.__code__.co_filename  # type: ignore[attr-defined]
WITHIN_TAICHI = (WATCH, quick_start.__file__)
"""Files of this package that Taichi calls, or that stand for it: their time is Taichi's."""
IN_TAICHI = "Taichi: launches, arguments, copies"
OTHERS = "Python: called by none of these"
RAYS = "send_messages"


@dataclass(frozen=True)
class KernelCost:
    """A kernel's calls, seconds and least bytes (None: not known) for one keyframe."""

    stage: str
    name: str
    calls: float
    seconds: float
    floor_bytes: float | None


@dataclass(frozen=True)
class HostCost:
    """Calls and seconds of a function for one keyframe: its own, and those of libraries that it calls."""

    stage: str
    function: str
    calls: float
    seconds: float


@dataclass(frozen=True)
class Profile:
    """One voxel size; means over ``keyframes`` new ones. ``waits`` are the times that the host waits for the
    device, ``wall`` seconds by stage, both for one keyframe."""

    voxel_size: float
    keyframes: int
    bytes_per_second: float
    work: Work
    wall: dict[str, float]
    waits: dict[str, float]
    kernels: list[KernelCost]
    host: list[HostCost]

    @property
    def step_seconds(self) -> float:
        """Seconds of the ray kernel for each voxel step."""
        seconds = sum(k.seconds for k in self.kernels if k.name == RAYS)
        return seconds / max(self.work.voxel_steps, 1.0)

    def to_json(self) -> dict[str, Any]:
        """All figures under their names."""
        return asdict(self) | {"step_seconds": self.step_seconds}


def profile_mapping(
    frames: Sequence[Frame],
    config: Config,
    bytes_per_second: float,
    measured: int,
    progress: Callable[[int], object] | None = None,
) -> Profile:
    """Map frames as a live run does, and profile the last ``measured`` of them: adding each, and its own
    sweep. Others are swept again meanwhile, unprofiled: their kernels are the same."""
    warm_up(MRFMap.from_config(config, frames[0].camera), frames)
    m = MRFMap.from_config(config, frames[0].camera)
    kernels: dict[tuple[str, str], list[float]] = defaultdict(list)
    host: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0])
    wall: dict[str, float] = defaultdict(float)
    waits: dict[str, float] = defaultdict(float)
    work = []
    for number, frame in enumerate(frames, start=1):
        bricks = len(m.view.pool.in_use)
        for name, stage in live_stages(m, frame).items():
            if number <= len(frames) - measured or name not in FLOORS:
                stage()
                continue
            _profile_stage(name, stage, kernels, host, wall, waits)
            if name == "own_sweep":
                work.append(_work_of(m, len(m.view.pool.in_use) - bricks))
        if progress is not None:
            progress(number)
    return _summary(config.voxel_size, bytes_per_second, work, kernels, host, wall, waits)


def _profile_stage(
    name: str,
    stage: Callable[[], object],
    kernels: dict[tuple[str, str], list[float]],
    host: dict[tuple[str, str], list[float]],
    wall: dict[str, float],
    waits: dict[str, float],
) -> None:
    by_taichi = runtime.active() != "vulkan"
    watch = cProfile.Profile()
    if by_taichi:
        ti.profiler.clear_kernel_profiler_info()
    with count_launches(timed=not by_taichi) as launches:
        wall[name] += timed(lambda: watch.runcall(stage)).wall
    waits[name] += launches.waits
    seconds = kernel_seconds() if by_taichi else launches.seconds
    for kernel, times in seconds.items():
        kernels[name, kernel] += times
    inside = sum(sum(times) for times in seconds.values())
    for function, (calls, spent) in host_seconds(watch).items():
        host[name, function][0] += calls
        host[name, function][1] += spent - (inside if function == IN_TAICHI else 0.0)


def kernel_seconds() -> dict[str, list[float]]:
    """Seconds of each launch, by the kernel's name, since Taichi's profiler was last cleared."""
    program = compiler.program()
    program.sync_kernel_profiler()
    program.update_kernel_profiler()
    seconds: dict[str, list[float]] = defaultdict(list)
    for record in program.get_kernel_profiler_records():
        # name_c12_0_kernel_1_range_for, or name_c12_0_0_t00: a kernel's loops are tasks of their own.
        name, _, task = re.sub(r"_c\d+_\d+_", " ", record.name, count=1).partition(" ")
        if not task.endswith("serial"):
            seconds[name].append(record.kernel_time * 1e-3)
    return seconds


def host_seconds(watch: cProfile.Profile) -> dict[str, tuple[int, float]]:
    """Calls and seconds of each function of this package, with what it spends in NumPy and the like; all that
    is spent in Taichi, kernels included, is one entry.

    What is divided is each function's own time, so that a callback, whoever calls it, counts once.
    """
    found: dict[str, tuple[int, float]] = defaultdict(lambda: (0, 0.0))
    stats = pstats.Stats(watch).stats  # type: ignore[attr-defined]
    owners: dict[Any, dict[str, float]] = {}
    for function, (_, calls, own, _, callers) in stats.items():
        title = _title(function)
        if title is not None and title != IN_TAICHI:
            found[title] = found[title][0] + calls, found[title][1] + own
            continue
        if title == IN_TAICHI:
            calls = sum(
                n for caller, (_, n, _, _) in callers.items() if _title(caller) not in (None, IN_TAICHI)
            )
            found[title] = found[title][0] + calls, found[title][1] + own
            continue
        for caller, (_, _, seconds, _) in callers.items():
            own -= seconds
            for owner, share in _owners(caller, stats, owners).items():
                found[owner] = found[owner][0], found[owner][1] + share * seconds
        found[OTHERS] = found[OTHERS][0], found[OTHERS][1] + own
    return dict(found)


def _owners(function: Any, stats: dict[Any, Any], known: dict[Any, dict[str, float]]) -> dict[str, float]:
    """Who answers for a function's time: itself, or, for a library's, its callers by the time that each one
    gives to it. The shares add up to one; ``known`` keeps them."""
    if function in known:
        return known[function]
    title = _title(function)
    if title is not None:
        known[function] = {title: 1.0}
        return known[function]
    known[function] = {OTHERS: 1.0}  # where calls go round in a circle
    callers = stats[function][4]
    total = sum(cumulative for _, _, _, cumulative in callers.values())
    shares: dict[str, float] = defaultdict(float)
    for caller, (_, _, _, cumulative) in callers.items() if total > 0 else ():
        for owner, share in _owners(caller, stats, known).items():
            shares[owner] += share * cumulative / total
    if shares:
        known[function] = dict(shares)
    return known[function]


def _title(function: tuple[str, int, str]) -> str | None:
    """Title under which a function's own time is listed; ``None``: as its caller's."""
    file, _, name = function
    if file.startswith((TAICHI, *WITHIN_TAICHI)):
        return IN_TAICHI
    if file.startswith(PACKAGE):
        return f"{Path(file).relative_to(PACKAGE).with_suffix('').as_posix()}: {name}"
    return None


def _work_of(m: MRFMap, created: int) -> Work:
    """Work of the newest keyframe, which has just been swept."""
    k = m.keyframes[max(m.keyframes)]
    spoken = 0 if k.messages is None else int(np.count_nonzero(k.messages.to_numpy()))
    return Work(
        pixels=k.camera.width * k.camera.height,
        rays=k.ray_list.number,
        crossed=len(k.footprint.crossed),
        surface=len(k.footprint.surface),
        created=created,
        visible=len(k.visible.slots),
        met=spoken,
        voxel_steps=m.last_voxel_steps,
        message_bytes=2 if m.LIMITS.precision == "float16" else 4,
        trace_in_cache=runtime.active() == "cpu" or runtime.is_software(),
    )


def _summary(
    voxel_size: float,
    bytes_per_second: float,
    works: list[Work],
    kernels: dict[tuple[str, str], list[float]],
    host: dict[tuple[str, str], list[float]],
    wall: dict[str, float],
    waits: dict[str, float],
) -> Profile:
    """Means over keyframes, most expensive first."""
    n = len(works)
    names = [name for name in asdict(works[0]) if name != "trace_in_cache"]
    means = {name: sum(getattr(work, name) for work in works) / n for name in names}
    work = Work(**means, trace_in_cache=works[0].trace_in_cache)
    kernel_costs = []
    for (stage, name), times in kernels.items():
        floor = FLOORS[stage].get(name)
        least = None if floor is None else floor(work)
        kernel_costs.append(KernelCost(stage, name, len(times) / n, sum(times) / n, least))
    host_costs = [
        HostCost(stage, name, calls / n, spent / n) for (stage, name), (calls, spent) in host.items()
    ]
    return Profile(
        voxel_size=voxel_size,
        keyframes=n,
        bytes_per_second=bytes_per_second,
        work=work,
        wall={stage: seconds / n for stage, seconds in wall.items()},
        waits={stage: count / n for stage, count in waits.items()},
        kernels=sorted(kernel_costs, key=lambda cost: -cost.seconds),
        host=sorted(host_costs, key=lambda cost: -cost.seconds),
    )
