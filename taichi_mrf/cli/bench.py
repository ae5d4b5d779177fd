"""The work of ``taichi-mrf bench``: read the frames, measure, print, write and draw."""

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from taichi_mrf.cli.options.measure import Bench
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.bench import BenchRow, bench_mapping, octomap_available
from taichi_mrf.evaluation.bench_pictures import draw_stages, write_figure
from taichi_mrf.evaluation.keyframe_cost import Seconds
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.files import exists

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Measured = tuple[list[Table], list[dict[str, Any]], "Callable[[], Figure] | None"]
"""Measurements: tables to print, figures to write, and what draws them, if they can be drawn."""


RATIOS = {"cpu_ratio_alone": "a keyframe without re-inference", "cpu_ratio_whole": "a keyframe"}
"""The figures that ``--gate`` compares, and their names: CPU time repeats better than the clock's."""

WORSE = 1.1
"""A ratio that has grown by more than this factor is worse."""


class BenchRun:
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

    def leave_out(self, peer: str) -> None:
        """Say that a peer is not installed."""
        self.console.print_line(f"{peer} is left out: pip install 'taichi-mrf[bench]' adds it.")


def measure_stages(run: BenchRun) -> Measured:
    """The stages of a new keyframe, beside OctoMap where that is installed."""
    with_octomap = run.options.octomap and octomap_available()
    if run.options.octomap and not with_octomap:
        run.leave_out("OctoMap")
    rows: list[BenchRow] = []
    for config, advance in run.each_size():
        rows.append(bench_mapping(run.frames, config, with_octomap, advance))
    draw = partial(draw_stages, rows, run.title)
    return [bench_table(rows, run.title)], [row.to_json() for row in rows], draw


def run_bench(
    options: Bench,
    measured: str = "stages",
    measure: Callable[[BenchRun], Measured] = measure_stages,
    profile: bool = False,
) -> int:
    """Measure, print, write and draw; 1 if ``--gate`` finds a ratio that has become worse, else 0. With
    ``profile`` Taichi times each kernel.

    Raises TaichiMRFError.
    """
    allowed = {} if options.gate is None else _ratios_in(options.gate, options)
    console = open_terminal(options.printing)
    wanted = options.settings.runtime
    runtime.init(wanted.arch, wanted.threads, profile=profile)
    with ProgressBar(console, options.printing) as progress:
        run = BenchRun(options, console, progress)
        tables, figures, draw = measure(run)
    for table in tables:
        console.print(table)
    if options.json is not None:
        report = {
            "device": run.device,
            "compiler": run.compiler,
            "source": options.source,
            "measured": measured,
            "rows": figures,
        }
        write_text(options.json, json.dumps(report, indent=2) + "\n")
    if options.plot is not None and draw is not None:
        write_figure(draw(), options.plot)
    worse = _worse(figures, allowed)
    for line in worse:
        console.print_line(line)
    return 1 if worse else 0


def _ratios_in(path: Path, options: Bench) -> dict[tuple[float, str], float]:
    """The ratios in a file of ``--json``, by voxel size and name. Raises ConfigError, before anything is
    measured, if they cannot be compared with those of a run with the options."""
    if not octomap_available():
        raise ConfigError("--gate needs OctoMap: pip install 'taichi-mrf[bench]'")
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        rows = {row["voxel_size"]: row for row in report["rows"]}
        ratios = {(size, name): float(rows[size][name]) for size in options.voxel_sizes for name in RATIOS}
    except OSError as error:
        raise ConfigError(f"--gate {path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        sizes = " ".join(f"{size:g}" for size in options.voxel_sizes)
        raise ConfigError(
            f"--gate {path}: holds no ratios to OctoMap for voxels of {sizes} m; taichi-mrf bench --json "
            "writes such a file"
        ) from error
    if report.get("source") != options.source:
        raise ConfigError(f"--gate {path}: was measured on {report.get('source')}, not on {options.source}")
    return ratios


def _worse(rows: Sequence[dict[str, Any]], allowed: dict[tuple[float, str], float]) -> list[str]:
    """A line for each ratio that is more than WORSE of what is allowed."""
    return [
        f"{row['voxel_size']:g} m: {RATIOS[name]} takes {row[name]:.3f} of OctoMap's CPU time, "
        f"{then:.3f} before"
        for row in rows
        for (size, name), then in allowed.items()
        if size == row["voxel_size"] and row[name] > WORSE * then
    ]


def _advance(progress: ProgressBar, stage: str, total: int, done: int) -> None:
    progress.advance(stage, done, total)


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
    line("CPU time: OctoMap, ms", lambda r: _cpu_ms(r.octomap))
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
