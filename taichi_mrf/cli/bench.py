"""The work of ``taichi-mrf bench``: read the frames, measure what was asked for, print, write and draw."""

import dataclasses
import json
import statistics
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from taichi_mrf.benchmark.bandwidth import Bandwidth, copy_bandwidth
from taichi_mrf.benchmark.bench import STEADY_FRAMES, BenchRow, bench_mapping, octomap_available
from taichi_mrf.benchmark.bench_pictures import draw_growth, draw_profiles, draw_stages, write_figure
from taichi_mrf.benchmark.growth import Growth, Lap, Line, measure_growth
from taichi_mrf.benchmark.keyframe_cost import Seconds
from taichi_mrf.benchmark.profile import KernelCost, Profile, profile_mapping
from taichi_mrf.benchmark.queries import (
    BALLS,
    BODIES,
    POINTS,
    RANGE_M,
    RAYS,
    REACH,
    QueryRow,
    Rate,
    bench_queries,
    missing_peers,
)
from taichi_mrf.cli.options.measure import MODES, Bench
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import open_dataset
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.files import exists

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Measured = tuple[list[Table], list[dict[str, Any]], "Callable[[], Figure] | None"]
"""Measurements: tables to print, figures to write, and what draws them, if they can be drawn."""

HOST_ROWS = 12
"""Functions of the host that are listed, at most; the rest is one row."""

_QUERY_NAMES = {"balls": "balls, by clearance", "rays": "rays, to what is occupied"}
"""Of the rates, those that are called otherwise here."""


class _Run:
    """One run of the command: its frames, and the bar that shows how far it is."""

    def __init__(self, options: Bench, console: Terminal, progress: ProgressBar) -> None:
        self.options, self.console, self.progress = options, console, progress
        dataset = open_dataset(options.source, color=False)
        count = min(options.frames, len(dataset))
        self.frames: list[Frame] = []
        for i in range(count):
            self.frames.append(dataset.read(i))
            progress.advance("reading", i + 1, count)
        sizes = options.voxel_sizes
        self.configs = [dataclasses.replace(options.settings, voxel_size=size) for size in sizes]
        choice = runtime.choice()
        self.device = f"{choice.name}, {choice.device}" if choice else ""
        path = Path(options.source)
        name = path.resolve().name if exists(path) else options.source
        self.compiler = choice.compiler if choice else ""
        self.title = f"{name}, {count} keyframes, on {self.device}, {self.compiler}"

    def each_size(self, what: str = "") -> Iterator[tuple[Config, Callable[[int], None]]]:
        """Each voxel size's parameters, and a function to call with the number of frames done."""
        for config in self.configs:
            stage = f"{config.voxel_size:g} m{what}"
            yield config, partial(_advance, self.progress, stage, len(self.frames))

    def stages(self) -> Measured:
        with_octomap = self.options.octomap and octomap_available()
        if self.options.octomap and not with_octomap:
            line = "OctoMap is left out: pip install 'taichi-mrf[bench]' brings it."
            self.console.print_line(line)
        rows: list[BenchRow] = []
        for config, advance in self.each_size():
            rows.append(bench_mapping(self.frames, config, with_octomap, advance))
        draw = partial(draw_stages, rows, self.title)
        return [bench_table(rows, self.title)], [row.to_json() for row in rows], draw

    def profile(self) -> Measured:
        bandwidth = copy_bandwidth()
        measured = max(1, min(STEADY_FRAMES, len(self.frames) // 4))
        rows: list[Profile] = []
        for config, advance in self.each_size():
            rate = bandwidth.bytes_per_second
            rows.append(profile_mapping(self.frames, config, rate, measured, advance))
        tables = profile_tables(rows, self.title, bandwidth)
        figures = [row.to_json() | {"bandwidth": bandwidth.how} for row in rows]
        return tables, figures, partial(draw_profiles, rows, self.title)

    def growth(self) -> Measured:
        rows: list[Growth] = []
        for kind in ("unseen", "seen"):
            for config, advance in self.each_size(f", {kind}"):
                rows.append(measure_growth(self.frames, config, kind, advance))
        rows.sort(key=lambda row: -row.voxel_size)
        draw = partial(draw_growth, rows, self.title)
        return [growth_table(rows, self.title)], [row.to_json() for row in rows], draw

    def queries(self) -> Measured:
        for name in missing_peers():
            line = f"{name} is left out: pip install 'taichi-mrf[bench]' brings it."
            self.console.print_line(line)
        rows: list[QueryRow] = []
        for config, advance in self.each_size():
            rows.append(bench_queries(self.frames, config, advance))
        return query_tables(rows, self.title), [row.to_json() for row in rows], None

    def viewer(self) -> Measured:
        from taichi_mrf.session.bench import bench_viewer  # the page's packages are slow to import

        rows = [bench_viewer(self.frames, config, advance) for config, advance in self.each_size()]
        figures = [
            {"voxel_size": config.voxel_size, "keyframes": [dataclasses.asdict(each) for each in row]}
            for config, row in zip(self.configs, rows, strict=True)
        ]
        return [viewer_table(self.options.voxel_sizes, rows, self.title)], figures, None


def run_bench(options: Bench) -> int:
    """Measure, print, write and draw; always 0. Raises TaichiMRFError."""
    console = open_terminal(options.printing)
    wanted = options.settings.runtime
    runtime.init(wanted.arch, wanted.threads, profile=options.profile)
    with ProgressBar(console, options.printing) as progress:
        run = _Run(options, console, progress)
        mode = next((name for name in MODES if getattr(options, name)), "stages")
        tables, figures, draw = getattr(run, mode)()
    for table in tables:
        console.print(table)
    if options.json is not None:
        report = {
            "device": run.device,
            "compiler": run.compiler,
            "source": options.source,
            "measured": mode,
            "rows": figures,
        }
        write_text(options.json, json.dumps(report, indent=2) + "\n")
    if options.plot is not None and draw is not None:
        write_figure(draw(), options.plot)
    return 0


def _advance(progress: ProgressBar, stage: str, total: int, done: int) -> None:
    progress.advance(stage, done, total)


def query_tables(rows: Sequence[QueryRow], title: str) -> list[Table]:
    """Million queries a second, and the seconds that distances take beside SciPy's transform."""
    return [_rate_table(rows, title), _distance_table(rows)]


def _rate_table(rows: Sequence[QueryRow], title: str) -> Table:
    sizes = [row.voxel_size for row in rows]
    table = size_columns(f"Million a second (for each processor's second): {title}", sizes)
    for name in rows[0].rates:
        table.add_row(_QUERY_NAMES.get(name, name), *[_rate(row.rates[name]) for row in rows])
    for name in rows[0].peers:
        table.add_row(name, *[_rate(row.peers[name]) for row in rows], style="dim")
    table.caption = (
        f"{POINTS:,} points, {RAYS:,} rays of up to {RANGE_M:g} m, and {BODIES:,} configurations of {BALLS} "
        "balls in a call; OctoMap is asked for the states of all points in one call, Open3D's rays meet the "
        "voxels as cubes."
    )
    table.caption_justify = "left"
    return table


def _distance_table(rows: Sequence[QueryRow]) -> Table:
    table = size_columns(
        f"Signed distances up to {REACH} voxels, seconds (processors' seconds)",
        [row.voxel_size for row in rows],
    )

    def line(name: str, figure: str) -> None:
        table.add_row(name, *[_seconds(getattr(row, figure)) for row in rows])

    line("of the whole map", "build")
    line("after one more keyframe", "update")
    table.add_row("  voxels that it changes", *[f"{row.changed:,}" for row in rows])
    line("SciPy, the box around the map", "transform")
    table.add_row("  voxels of the box", *[f"{row.box_voxels:,}" for row in rows])
    table.add_row("memory of the field, MB", *[f"{row.field_mb:.0f}" for row in rows])
    return table


def _seconds(seconds: Seconds | None) -> str:
    return "-" if seconds is None else f"{seconds.wall:.3f} ({seconds.cpu:.3f})"


def _rate(rate: Rate) -> str:
    return f"{rate.millions:.2f} ({rate.cpu_millions:.2f})"


if TYPE_CHECKING:  # the page's packages are slow to import
    from taichi_mrf.session.bench import ViewerRow


def bench_table(rows: Sequence[BenchRow], title: str) -> Table:
    """Medians of the steady state, beside OctoMap and the targets."""
    table = size_columns(title, [row.voxel_size for row in rows])

    def line(name: str, text: Callable[[BenchRow], str]) -> None:
        table.add_row(name, *[text(row) for row in rows])

    def target(row: BenchRow, of: int) -> str:
        return "-" if row.targets is None else f"{row.targets[of]:g}"

    steady = sorted({row.steady for row in rows})
    table.caption = f"Medians over the last {' or '.join(map(str, steady))} keyframes."
    table.caption_justify = "left"
    line("allocate, ms", lambda r: _ms(r.allocate))
    line("its own sweep, ms", lambda r: _ms(r.own_sweep))
    line("re-inference of others, ms", lambda r: _ms(r.reinference))
    line("  keyframes swept again (mean)", lambda r: f"{r.swept_again:.1f}")
    line("OctoMap, ms", lambda r: _ms(r.octomap))
    line("without re-inference, ms", lambda r: _ms(r.alone))
    line("  ratio to OctoMap", lambda r: _ratio(r.ratio_alone))
    line("  target, at most", lambda r: target(r, 0))
    line("whole cost, ms", lambda r: _ms(r.whole))
    line("  its mean, ms", lambda r: _ms(r.whole_mean))
    line("  ratio to OctoMap", lambda r: _ratio(r.ratio_whole))
    line("  target, at most", lambda r: target(r, 1))
    line("processors' time: OctoMap, ms", lambda r: _cpu_ms(r.octomap))
    line("  without re-inference, ms", lambda r: _cpu_ms(r.alone))
    line("  whole cost, ms", lambda r: _cpu_ms(r.whole))
    line("one sweep, all inferred, ms", lambda r: _ms(r.full_sweep))
    line("pixels with a measurement", lambda r: f"{r.pixels:,}")
    line("rays cast for them", lambda r: f"{r.rays:,}")
    line("voxel steps a sweep", lambda r: f"{r.voxel_steps:,.0f}")
    line("million steps a second", lambda r: f"{r.voxel_steps / r.full_sweep.wall / 1e6:.1f}")
    line("occupancy of 100,000 points, ms", lambda r: _ms(r.occupancy))
    line("render a depth image, ms", lambda r: _ms(r.render_depth))
    line("extract occupied voxels, ms", lambda r: _ms(r.extract))
    line("bricks", lambda r: f"{r.bricks:,}")
    line("voxels", lambda r: f"{r.voxels:,}")
    line("bytes a voxel, all keyframes", lambda r: f"{r.bytes_per_voxel:.1f}")
    line("peak memory, MB", lambda r: "-" if r.peak_memory_mb is None else f"{r.peak_memory_mb:.0f}")
    return table


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


def growth_table(rows: Sequence[Growth], title: str) -> Table:
    """One row for each voxel size and kind: fitted lines, and their values at a thousand keyframes."""
    table = Table(title=f"New keyframes beside old ones: {title}", title_justify="left")
    table.add_column("")
    table.add_column("old ones")
    for name in ("alone, ms", "whole (mean), ms", "processors, ms", "memory, MB"):
        table.add_column(name, justify="right")
    figures: list[tuple[Callable[[Lap], float], float]] = [
        (lambda lap: lap.alone.wall, 1e3),
        (lambda lap: lap.whole.wall, 1e3),
        (lambda lap: lap.whole.cpu, 1e3),
        (lambda lap: lap.memory_mb, 1.0),
    ]
    for row in rows:
        texts = [_line(row.line(figure), scale) for figure, scale in figures]
        table.add_row(f"{row.voxel_size * 100:g} cm", row.kind, *texts)
    table.caption = (
        "At no old keyframe + for each old one (± standard error). Alone: without re-inference of others; "
        "processors: their time for the whole."
    )
    table.caption_justify = "left"
    return table


def _line(line: Line, scale: float) -> str:
    error = "" if line.slope_error is None else f" ± {line.slope_error * scale:.4f}"
    return f"{line.at_zero * scale:.1f} + {line.slope * scale:.4f}{error}"


def viewer_table(voxel_sizes: Sequence[float], benches: "Sequence[Sequence[ViewerRow]]", title: str) -> Table:
    """Medians over keyframes, and the largest."""
    table = Table(title=f"Live view: {title}", title_justify="left")
    table.add_column("a keyframe: median (largest)")
    for size in voxel_sizes:
        table.add_column(f"{size * 100:g} cm", justify="right")

    def line(name: str, figure: str, scale: float, digits: int) -> None:
        texts = []
        for rows in benches:
            values = [getattr(row, figure) * scale for row in rows]
            texts.append(f"{statistics.median(values):,.{digits}f} ({max(values):,.{digits}f})")
        table.add_row(name, *texts)

    line("find the changes, ms", "publish", 1e3, 1)
    line("draw them, ms", "draw", 1e3, 1)
    line("changed bricks", "changed", 1, 0)
    line("sent to a browser, MB", "sent", 1e-6, 2)
    table.add_row("voxels shown in the end", *[f"{rows[-1].shown:,}" for rows in benches])
    return table


def size_columns(title: str, voxel_sizes: Sequence[float]) -> Table:
    """A table with a column for what is in the row, and one for each voxel size, in metres."""
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for size in voxel_sizes:
        table.add_column(f"{size * 100:g} cm", justify="right")
    return table


def _ms(seconds: Seconds | None) -> str:
    return "-" if seconds is None else f"{seconds.wall * 1e3:.1f}"


def _cpu_ms(seconds: Seconds | None) -> str:
    return "-" if seconds is None else f"{seconds.cpu * 1e3:.1f}"


def _ratio(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
