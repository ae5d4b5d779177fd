"""Needs of maps of a building, a campus and a city, reckoned from what was measured on the corridor."""

from collections.abc import Sequence
from dataclasses import dataclass

from taichi_mrf.evaluation.tables import Entry, Table

SECONDS_A_DAY = 86400.0


@dataclass(frozen=True)
class MeasuredCost:
    """Cost of one keyframe and of one square metre of floor, as measured at one voxel size.

    ``seconds`` of a CPU core for a keyframe in one submap and one round, with all of its sweeps;
    ``keyframe_mb`` that it takes in a task's memory; ``overlap`` submaps that a keyframe belongs to;
    ``rounds`` of inference that were made; ``submap_m`` the side of a column;
    ``voxels_per_m2`` near surfaces, and what each takes in memory and in the store, in bytes.
    """

    voxel_size: float
    seconds: float
    keyframe_mb: float
    overlap: float
    rounds: int
    submap_m: float
    keyframes_per_m2: float
    voxels_per_m2: float
    memory_bytes_per_voxel: float
    store_bytes_per_voxel: float


@dataclass(frozen=True)
class Place:
    """Something to be mapped: its floor, all storeys together, or its streets and squares; and how many
    keyframes see each square metre from close by, None for as many as in the corridor."""

    name: str
    area_m2: float
    keyframes_per_m2: float | None = None


PLACES = (
    Place("building: 5 storeys of 2,000 m2", 10_000),
    Place("campus: 50 such buildings", 500_000),
    Place("city: 100 km2, a quarter of it streets and squares", 25_000_000),
)
COLUMNS = (
    "place",
    "area (m2)",
    "keyframes",
    "submaps",
    "core-days",
    "GB a task",
    "store (GB)",
)


@dataclass(frozen=True)
class Need:
    """Needs of a place. ``task_gb`` is the memory of a task with a column of average content."""

    keyframes: float
    submaps: float
    core_days: float
    task_gb: float
    store_gb: float


def need(place: Place, cost: MeasuredCost) -> Need:
    """Simple proportions: time and memory with keyframes, size with area."""
    density = cost.keyframes_per_m2 if place.keyframes_per_m2 is None else place.keyframes_per_m2
    keyframes = place.area_m2 * density
    column_m2 = cost.submap_m**2
    voxels = place.area_m2 * cost.voxels_per_m2
    seconds = keyframes * cost.overlap * cost.rounds * cost.seconds
    in_a_task = column_m2 * density * cost.overlap
    # A task holds its core, and about as much again for each further column that its rays reach.
    task_voxels = column_m2 * cost.voxels_per_m2 * cost.overlap
    return Need(
        keyframes=keyframes,
        submaps=place.area_m2 / column_m2,
        core_days=seconds / SECONDS_A_DAY,
        task_gb=(in_a_task * cost.keyframe_mb * 1e6 + task_voxels * cost.memory_bytes_per_voxel) / 1e9,
        store_gb=voxels * cost.store_bytes_per_voxel / 1e9,
    )


def costs_table(costs: Sequence[MeasuredCost], places: Sequence[Place] = PLACES) -> Table:
    """A row for each place and voxel size."""
    rows: list[list[Entry]] = []
    for cost in costs:
        for place in places:
            found = need(place, cost)
            rows.append(
                [
                    f"{place.name}, {cost.voxel_size * 100:g} cm",
                    f"{place.area_m2:,.0f}",
                    f"{found.keyframes:,.0f}",
                    f"{found.submaps:,.0f}",
                    f"{found.core_days:,.2f}",
                    f"{found.task_gb:.2f}",
                    f"{found.store_gb:,.2f}",
                ]
            )
    notes = [
        f"{c.voxel_size * 100:g} cm: {c.keyframes_per_m2:.2f} keyframes/m2 of 640 x 480, "
        f"{c.seconds:.2f} core-seconds each in a submap and round, {c.overlap:.2f} submaps each, "
        f"{c.rounds} rounds, {c.keyframe_mb:.1f} MB each, {c.voxels_per_m2:,.0f} voxels/m2 near surfaces of "
        f"{c.memory_bytes_per_voxel:.1f} bytes in memory and {c.store_bytes_per_voxel:.2f} in the store"
        for c in costs
    ]
    notes.append("measured on the corridor and scaled in proportion; times are those of one CPU core")
    return Table("submaps_costs", "What larger places would need", COLUMNS, rows, notes)
