"""``taichi-mrf bench``: how long each stage takes here, and how long OctoMap takes for the same."""

import dataclasses
import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from taichi_mrf.config import Config
from taichi_mrf.errors import ConfigError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table

    from taichi_mrf.evaluation.bench import BenchRow
    from taichi_mrf.live.bench import ViewerRow


@dataclass(frozen=True)
class Bench:
    """Time each stage of mapping on a sequence, at several voxel sizes.

    Example: taichi-mrf bench recording/ --voxel-sizes 0.05 0.02 --frames 30
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = "synthetic:room"
    """A folder, whose format is recognised, or a built-in sequence."""

    voxel_sizes: tuple[float, ...] = (0.05, 0.02, 0.01)
    """Voxel sizes in metres."""

    frames: int = 30
    """How many frames to map, from the first on."""

    octomap: bool = True
    """Insert the same frames into OctoMap, where the extra 'bench' is installed."""

    viewer: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Measure instead what each keyframe costs the live view: time on the server and bytes to a browser."""

    json: Path | None = None
    """Write the figures to this file as well."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """Parameters; the voxel size among them is not used."""

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise ConfigError(f"--frames must be at least 1, not {self.frames}")

    def run(self) -> int:
        """Measure and print the table. Raises TaichiMRFError."""
        from rich.console import Console
        from rich.progress import Progress

        from taichi_mrf import runtime
        from taichi_mrf.datasets import open_dataset
        from taichi_mrf.evaluation.bench import bench_mapping, octomap_available
        from taichi_mrf.export.atomic import write_text
        from taichi_mrf.live.bench import bench_viewer

        console = Console()
        configs = [dataclasses.replace(self.settings, voxel_size=size) for size in self.voxel_sizes]
        with_octomap = self.octomap and not self.viewer and octomap_available()
        if self.octomap and not self.viewer and not with_octomap:
            console.print("OctoMap is left out: pip install 'taichi-mrf[bench]' brings it.", markup=False)
        runtime.init(self.settings.runtime.arch, self.settings.runtime.threads, self.settings.runtime.debug)
        dataset = open_dataset(self.source, color=False)
        count = min(self.frames, len(dataset))
        rows, viewer_rows = [], []
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            reading = progress.add_task("reading", total=count)
            frames = []
            for i in range(count):
                frames.append(dataset.read(i))
                progress.advance(reading)
            for config in configs:
                task = progress.add_task(f"{config.voxel_size:g} m", total=count)
                advance = partial(_advance, progress, task)
                if self.viewer:
                    viewer_rows.append(bench_viewer(frames, config, advance))
                else:
                    rows.append(bench_mapping(frames, config, with_octomap, advance))
        choice = runtime.choice()
        where = f"{choice.name}, {choice.device}" if choice else ""
        title = f"{self.source}, {count} keyframes, on {where}"
        console.print(
            viewer_table(self.voxel_sizes, viewer_rows, title) if self.viewer else bench_table(rows, title)
        )
        if self.json is not None:
            figures: list[Any] = [
                dataclasses.asdict(row) | {"ratio": row.ratio, "ratio_in_full": row.ratio_in_full}
                for row in rows
            ]
            for size, keyframes in zip(self.voxel_sizes, viewer_rows, strict=bool(viewer_rows)):
                figures.append(
                    {"voxel_size": size, "keyframes": [dataclasses.asdict(row) for row in keyframes]}
                )
            write_text(self.json, json.dumps({"device": where, "rows": figures}, indent=2) + "\n")
        return 0


def _advance(progress: "Progress", task: "TaskID", done: int) -> None:
    progress.update(task, completed=done)


def viewer_table(voxel_sizes: Sequence[float], benches: "list[list[ViewerRow]]", title: str) -> "Table":
    """One column for each voxel size: medians over keyframes, and the largest."""
    from rich.table import Table

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


def bench_table(rows: "list[BenchRow]", title: str) -> "Table":
    """One column for each voxel size; times are medians."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("")
    for row in rows:
        table.add_column(f"{row.voxel_size * 100:g} cm", justify="right")

    def line(name: str, texts: list[str]) -> None:
        table.add_row(name, *texts)

    def milliseconds(value: float | None) -> str:
        return "-" if value is None else f"{value * 1e3:.1f}"

    def ratio(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    line("allocate, ms", [milliseconds(r.allocate) for r in rows])
    line("visible bricks, ms", [milliseconds(r.visible) for r in rows])
    line("3 sweeps over it, ms", [milliseconds(r.sweeps) for r in rows])
    line("add a keyframe (all of these), ms", [milliseconds(r.add) for r in rows])
    line("OctoMap, ms", [milliseconds(r.octomap) for r in rows])
    line("ratio to OctoMap", [ratio(r.ratio) for r in rows])
    line("one whole sweep, ms", [milliseconds(r.sweep) for r in rows])
    line("ratio with 3 whole sweeps", [ratio(r.ratio_in_full) for r in rows])
    line("rays a sweep", [f"{r.rays:,}" for r in rows])
    line("million rays a second", [f"{r.rays / r.sweep / 1e6:.2f}" for r in rows])
    line("voxel steps a sweep", [f"{r.voxel_steps:,.0f}" for r in rows])
    line("million steps a second", [f"{r.voxel_steps / r.sweep / 1e6:.1f}" for r in rows])
    line("occupancy of 100,000 points, ms", [milliseconds(r.occupancy) for r in rows])
    line("render a depth image, ms", [milliseconds(r.render_depth) for r in rows])
    line("extract occupied voxels, ms", [milliseconds(r.extract) for r in rows])
    line("bricks", [f"{r.bricks:,}" for r in rows])
    line("voxels", [f"{r.voxels:,}" for r in rows])
    line("bytes a voxel, all keyframes", [f"{r.bytes_per_voxel:.1f}" for r in rows])
    line("peak memory, MB", ["-" if r.peak_memory_mb is None else f"{r.peak_memory_mb:.0f}" for r in rows])
    return table
