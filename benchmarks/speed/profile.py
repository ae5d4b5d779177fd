"""Profile of a new keyframe: every kernel by Taichi's own profiler, the host by Python's, and the least that
each kernel must read and write.

Taichi has to be started with ``runtime.init(profile=True)``. On Vulkan, where its profiler does not work with
so many kernels, launches are timed instead, which has a launch's own cost in it. Profiling slows the host
down. `taichi-mrf bench` measures what a keyframe costs; this divides that cost among kernels and host.

The bytes of a kernel, divided by the memory's bandwidth, are a floor under its time: nothing that computes
the same can be faster, unless its data are still in a cache. Every array is counted once, however often it is
touched.

Launches are watched from outside: how often the host waits for the device, and how long each takes. On a
device with a memory of its own, the launch of a kernel that is handed a NumPy array waits until that has been
copied there and back; reading an array back is such a launch too. On a CPU no copy is needed.
"""

import cProfile
import pstats
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

import taichi_mrf
from benchmarks.speed.bandwidth import Bandwidth, copy_bandwidth
from taichi_mrf import Config, Frame, MRFMap
from taichi_mrf.cli.bench import BenchRun, Measured
from taichi_mrf.evaluation.bench import STEADY_FRAMES
from taichi_mrf.evaluation.bench_pictures import STAGE_COLORS, STAGE_NAMES, TARGET_COLOR, legend_below
from taichi_mrf.evaluation.keyframe_cost import live_stages, timed, warm_up
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.inference.sweep import TRACE_BYTES
from taichi_mrf.system import compiler, quick_launch, quick_start, runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import VOXELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floor = Callable[["Work"], float]

HOST_ROWS = 12
"""Functions of the host that are listed, at most; the rest is one row."""

KERNELS_DRAWN = 8
SHORTEST_MS = 0.01
"""Lower end of the logarithmic scale of kernels."""


@dataclass(frozen=True)
class Work:
    """Work of a keyframe for its kernels.

    ``crossed``, ``surface``, ``created`` and ``visible`` are bricks (see inference/keyframe.py); ``met`` are
    the voxels that get a message, ``voxel_steps`` those crossed, each ray's counted. ``message_bytes`` are
    those of one message. ``trace_in_cache``: whether a ray's steps never reach the memory.
    """

    pixels: float
    rays: float
    crossed: float
    surface: float
    created: float
    visible: float
    met: float
    voxel_steps: float
    message_bytes: float
    trace_in_cache: bool

    @property
    def voxels(self) -> float:
        """Voxels of the visible bricks."""
        return self.visible * VOXELS

    @property
    def trace_bytes(self) -> float:
        """Bytes of the trace, written once and read once."""
        return 0.0 if self.trace_in_cache else 2 * TRACE_BYTES * self.voxel_steps


FLOORS: Mapping[str, Mapping[str, Floor]] = {
    "allocate": {
        "ext_arr_to_ndarray": lambda w: 8 * w.pixels,  # the depth image, to the device
        "_choose": lambda w: 24 * w.pixels,  # depth in; nearest, farthest, mean, two levels out
        "_write_down": lambda w: 8 * w.pixels + 12 * w.rays,  # levels and means in, the list out
        "_find_reach": lambda w: 12 * w.rays,  # the list in, depths out
        "_mark": lambda w: 8 * w.rays + 4 * w.crossed,  # the list in, marks out
        "read": lambda w: 20 * (w.surface + w.crossed),  # coordinates and the tree in, slots out
        "fill_bricks": lambda w: (4 + 4 * VOXELS) * w.created,
        "write": lambda w: 20 * w.created,  # coordinates and slots in, the tree out
        "count": lambda w: 20 * w.crossed,  # coordinates in, the tree in and out
    },
    "own_sweep": {
        "_clear": lambda w: w.message_bytes * w.voxels,  # new messages
        "cavity": lambda w: (
            (4 + w.message_bytes + 4 + 8) * w.voxels
        ),  # belief, message in; log_free, sums out
        "_enter": lambda w: 12 * w.visible,  # cells and their order in, index out
        "_take_out": lambda w: 8 * w.visible,  # cells in, index out
        "send_messages": lambda w: 12 * w.rays + (4 + 8 + 8) * w.met + w.trace_bytes,
        "finish": lambda w: 8 * w.voxels + (2 * w.message_bytes + 8) * w.met,
        "ndarray_to_ext_arr": lambda w: 8 * w.visible,  # how many moved
    },
}
"""By stage and by the kernel's name."""

COPIES = ("ext_arr_to_ndarray", "ndarray_to_ext_arr")
"""Those that bring arrays to the device and back: there are none on a CPU (kernels/resident.py)."""


@dataclass
class Launches:
    """``number`` of launches, and those that the host has to ``wait`` for, because a NumPy array goes in or
    comes out; ``seconds`` of each launch by the kernel's name, if they are timed."""

    number: int = 0
    waits: int = 0
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


@contextmanager
def count_launches(timed: bool = False) -> Iterator[Launches]:
    """Watch all launches while the block runs. ``timed`` waits for each kernel, so as to time it."""
    launches = Launches()
    kernels = compiler.kernel_class()
    launch = kernels.__call__
    apart = runtime.active() != "cpu"

    def watched(self: Any, *arguments: Any, **named: Any) -> Any:
        launches.number += 1
        launches.waits += apart and any(isinstance(argument, np.ndarray) for argument in arguments)
        if not timed:
            return launch(self, *arguments, **named)
        ti.sync()
        begin = time.perf_counter()
        result = launch(self, *arguments, **named)
        ti.sync()
        launches.seconds[self.func.__name__].append(time.perf_counter() - begin)
        return result

    kernels.__call__ = watched
    try:
        yield launches
    finally:
        kernels.__call__ = launch


PACKAGE = str(Path(taichi_mrf.__file__).parent)
TAICHI = str(Path(ti.__file__).parent)
WATCH = count_launches.__wrapped__.__code__.co_filename  # type: ignore[attr-defined]
WITHIN_TAICHI = (WATCH, quick_start.__file__, quick_launch.__file__)
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


def measure_profile(run: BenchRun) -> Measured:
    """Every kernel beside the bound that memory bandwidth sets, and the host's functions."""
    bandwidth = copy_bandwidth()
    measured = max(1, min(STEADY_FRAMES, len(run.frames) // 4))
    rows: list[Profile] = []
    for config, advance in run.each_size():
        rows.append(profile_mapping(run.frames, config, bandwidth.bytes_per_second, measured, advance))
    tables = profile_tables(rows, run.title, bandwidth)
    figures = [row.to_json() | {"bandwidth": bandwidth.how} for row in rows]
    return tables, figures, partial(draw_profiles, rows, run.title)


def profile_tables(rows: Sequence[Profile], title: str, bandwidth: Bandwidth) -> list[Table]:
    """Two tables for each voxel size: kernels beside their floors, and the host's functions."""
    tables = []
    memory = f"memory: {bandwidth.bytes_per_second / 1e9:.1f} GB/s, {bandwidth.how}"
    for row in rows:
        tables += [_kernel_table(row, title, memory), _host_table(row)]
    return tables


def _kernel_table(row: Profile, title: str, memory: str) -> Table:
    work = row.work
    table = Table(title=f"{row.voxel_size * 100:g} cm, kernels: {title}", title_justify="left")
    for name in ("stage", "kernel"):
        table.add_column(name, no_wrap=True, overflow="fold")
    for name in ("calls", "ms", "MB", "floor, ms", "share"):
        table.add_column(name, justify="right")
    for kernel in row.kernels:
        calls = f"{kernel.calls:.1f}"
        table.add_row(kernel.stage, kernel.name, calls, f"{kernel.seconds * 1e3:.3f}", *_floor(kernel, row))
    table.caption_justify = "left"
    table.caption = (
        "MB: the least to be read and written; floor: what that takes; share: of the time taken. "
        f"A keyframe, mean of {row.keyframes}: {work.rays:,.0f} rays, {work.crossed:,.0f} bricks crossed, "
        f"{work.visible:,.0f} visible, {work.voxel_steps:,.0f} voxel steps at "
        f"{row.step_seconds * 1e9:.1f} ns; {memory}."
    )
    return table


def _floor(kernel: KernelCost, row: Profile) -> list[str]:
    if kernel.floor_bytes is None:
        return ["-", "-", "-"]
    least = kernel.floor_bytes / row.bytes_per_second
    share = f"{100 * least / max(kernel.seconds, 1e-9):.1f}%"
    return [f"{kernel.floor_bytes / 1e6:.2f}", f"{least * 1e3:.3f}", share]


def _host_table(row: Profile) -> Table:
    table = Table(title=f"{row.voxel_size * 100:g} cm, host", title_justify="left")
    for name in ("stage", "function, with the libraries that it calls"):
        table.add_column(name)
    for name in ("calls", "ms"):
        table.add_column(name, justify="right")
    shown, rest = row.host[:HOST_ROWS], row.host[HOST_ROWS:]
    for host in shown:
        table.add_row(host.stage, host.function, f"{host.calls:.1f}", f"{host.seconds * 1e3:.3f}")
    table.add_row("", f"{len(rest)} others", "", f"{sum(each.seconds for each in rest) * 1e3:.3f}")
    for stage, seconds in row.wall.items():
        in_kernels = sum(k.seconds for k in row.kernels if k.stage == stage)
        text = (
            f"all, of which {in_kernels * 1e3:.3f} ms in kernels; {row.waits[stage]:.1f} waits for the device"
        )
        table.add_row(stage, text, "", f"{seconds * 1e3:.3f}", style="bold")
    return table


def draw_profiles(rows: Sequence[Profile], title: str) -> "Figure":
    """The most expensive kernels at each voxel size, and the floors under them, on a logarithmic scale."""
    figure = new_figure(4.4 * len(rows) + 1.0, 4.2)
    figure.suptitle(f"Kernels of a new keyframe: {title}", fontsize=9, wrap=True)
    panels = figure.subplots(1, len(rows), squeeze=False)[0]
    for axes, row in zip(panels, rows, strict=True):
        shown = row.kernels[:KERNELS_DRAWN][::-1]
        place = np.arange(len(shown))
        taken = [kernel.seconds * 1e3 for kernel in shown]
        floors = [(kernel.floor_bytes or 0.0) / row.bytes_per_second * 1e3 for kernel in shown]
        for stage in row.wall:
            width = [ms if kernel.stage == stage else 0.0 for ms, kernel in zip(taken, shown, strict=True)]
            axes.barh(place, width, 0.75, color=STAGE_COLORS[stage], label=STAGE_NAMES[stage])
        axes.barh(place, floors, 0.35, color=TARGET_COLOR, label="least that its bytes could take")
        axes.set_yticks(place, [kernel.name for kernel in shown])
        axes.set(
            xscale="log",
            xlim=(SHORTEST_MS, 2 * max(taken)),
            xlabel="ms a keyframe, logarithmic",
            title=f"{row.voxel_size * 100:g} cm",
        )
        axes.spines[["top", "right"]].set_visible(False)
    legend_below(figure, panels)
    return figure
