"""The work of ``taichi-mrf bench``: read the frames, measure what was asked for, print, write and draw."""

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from taichi_mrf.benchmark.bandwidth import copy_bandwidth
from taichi_mrf.benchmark.bench import STEADY_FRAMES, BenchRow, bench_mapping, octomap_available
from taichi_mrf.benchmark.bench_pictures import draw_growth, draw_profiles, draw_stages, write_figure
from taichi_mrf.benchmark.growth import Growth, measure_growth
from taichi_mrf.benchmark.keyframe_cost import Seconds
from taichi_mrf.benchmark.profile import Profile, profile_mapping
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
from taichi_mrf.cli.bench.tables import bench_table, growth_table, profile_tables, size_columns, viewer_table
from taichi_mrf.cli.options.bench import MODES, Bench
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
