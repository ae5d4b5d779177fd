"""The tables of ``taichi-mrf bench --queries``: rates, and what distances cost; a column for each voxel
size."""

from collections.abc import Sequence

from rich.table import Table

from taichi_mrf.benchmark.keyframe_cost import Seconds
from taichi_mrf.benchmark.queries import BALLS, BODIES, POINTS, RANGE_M, RAYS, REACH, QueryRow, Rate
from taichi_mrf.cli.bench.tables import size_columns

_NAMES = {"balls": "balls, by clearance", "rays": "rays, to what is occupied"}
"""Of the rates, those that are called otherwise here."""


def query_tables(rows: Sequence[QueryRow], title: str) -> list[Table]:
    """Million queries a second, and the seconds that distances take beside SciPy's transform."""
    return [_rate_table(rows, title), _distance_table(rows)]


def _rate_table(rows: Sequence[QueryRow], title: str) -> Table:
    sizes = [row.voxel_size for row in rows]
    table = size_columns(f"Million a second (for each processor's second): {title}", sizes)
    for name in rows[0].rates:
        table.add_row(_NAMES.get(name, name), *[_rate(row.rates[name]) for row in rows])
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
