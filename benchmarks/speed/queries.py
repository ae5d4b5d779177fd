"""How fast a planner's queries are: million points a second, and the time of a planner's call, beside
OctoMap, SciPy and Open3D on the same map.

The peers get the map itself, as a file: OctoMap an octree of it, Open3D its voxels as cubes, SciPy the
states of the box around it. Points lie anywhere in this box, rays begin there in any direction; a planner's
begin where the map is free. The first call, which compiles kernels, does not count; of those after it the
fastest does.
"""

import importlib.util
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.ndimage import distance_transform_edt

from taichi_mrf import (
    FREE,
    OCCUPIED,
    Config,
    DistanceField,
    ExportOptions,
    Frame,
    MRFMap,
    cast_rays,
    export_map,
    read_box,
)
from taichi_mrf.cli.bench import BenchRun, Measured, size_columns
from taichi_mrf.evaluation.keyframe_cost import Seconds, timed
from taichi_mrf.system.libraries import library

POINTS = 1_000_000
RAYS = 100_000
RANGE_M = 5.0
ASKED, FEW = 10_000, 10
"""Points or rays in a planner's call, and in one whose time is that of the call itself."""

BODIES, BALLS = 1000, 50
"""Configurations of a robot in a call, and the balls that it is made of."""

REACH = 20
"""Voxels that distances reach."""

LARGEST_BOX = 50_000_000
"""Voxels up to which SciPy is asked: it takes 40 bytes for each."""

_TRIES = 5

Points: TypeAlias = NDArray[np.float64]
Asked = Callable[[], object]
Asking = Callable[[Points, Points], object]
"""A question about places (n, 3), and about rays that begin there, with their ways (n, 3)."""


@dataclass(frozen=True)
class Rate:
    """Queries ``count`` in a call, and how long the fastest call took."""

    count: int
    seconds: Seconds

    @property
    def millions(self) -> float:
        """Million queries a second."""
        return self.count / self.seconds.wall / 1e6

    @property
    def cpu_millions(self) -> float:
        """Million queries for each second of a processor's time."""
        return self.count / max(self.seconds.cpu, 1e-9) / 1e6


@dataclass(frozen=True)
class QueryRow:
    """One voxel size. ``rates`` are this package's, ``peers`` the others', by name, and ``calls`` how
    long a planner's call takes by what it asks, with ASKED of them and with FEW. ``build`` is how long all
    distances of the map take, ``update`` those that one more keyframe changes, ``changed`` voxels;
    ``transform`` is SciPy's for the same box of ``box_voxels``, of obstacles and of all else, None if the box
    is too large; ``field_mb`` is what the field takes."""

    voxel_size: float
    keyframes: int
    rates: dict[str, Rate]
    build: Seconds
    update: Seconds
    changed: int
    field_mb: float
    transform: Seconds | None
    box_voxels: int
    peers: dict[str, Rate] = field(default_factory=dict)
    calls: dict[str, tuple[Seconds, Seconds]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """All figures under their names, with the rates."""
        millions = {
            group: {
                name: {"millions": rate.millions, "cpu_millions": rate.cpu_millions}
                for name, rate in getattr(self, group).items()
            }
            for group in ("rates", "peers")
        }
        return asdict(self) | millions


def missing_peers() -> list[str]:
    """Of OctoMap and Open3D, those that are not installed."""
    modules = {"OctoMap": "pyoctomap", "Open3D": "open3d"}
    return [name for name, module in modules.items() if importlib.util.find_spec(module) is None]


def bench_queries(
    frames: Sequence[Frame], config: Config, progress: Callable[[int], object] = lambda done: None
) -> QueryRow:
    """Map all frames but the last, ask, and add the last for the update of the distances."""
    m = MRFMap.from_config(config, frames[0].camera)
    last = frames[-1]
    for number, frame in enumerate(frames[:-1] or frames, start=1):
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
        progress(number)
    m.infer()
    max_distance_m = REACH * m.voxel_size
    lower, upper = _extent(m)
    random = np.random.default_rng(0)
    points = random.uniform(lower, upper, (POINTS, 3))
    starts, ways = points[:RAYS], random.normal(size=(RAYS, 3))
    bodies = points[:BODIES, None] + random.normal(0.0, 0.3, (BODIES, BALLS, 3))
    radii = random.uniform(0.2, 0.9, BALLS) * max_distance_m

    distances = DistanceField(m, max_distance_m)
    build = fastest(lambda: DistanceField(m, max_distance_m), tries=2)
    rates = {
        "occupancy": Rate(POINTS, fastest(lambda: m.occupancy(points))),
        "state": Rate(POINTS, fastest(lambda: m.state(points))),
        "distance": Rate(POINTS, fastest(lambda: distances.distance(points))),
        "distance and gradient": Rate(POINTS, fastest(lambda: distances.distance_and_gradient(points))),
        "balls": Rate(BODIES * BALLS, fastest(lambda: distances.clearance(bodies, radii))),
        "rays": Rate(RAYS, fastest(lambda: cast_rays(m, starts, ways, RANGE_M))),
        "rays of an image": Rate(
            last.depth_m.size, fastest(lambda: m.render_depth(last.camera, last.T_world_camera))
        ),
    }
    asked: dict[str, Asking] = {
        "states": lambda places, ways: m.state(places),
        "distances": lambda places, ways: distances.distance(places),
        "rays": lambda places, ways: cast_rays(m, places, ways, RANGE_M),
        "rays that the unknown stops": lambda places, ways: cast_rays(m, places, ways, RANGE_M, "stop"),
    }
    box_voxels = round(float(np.prod((upper - lower) / m.voxel_size)))
    transform = None
    if box_voxels <= LARGEST_BOX:
        obstacle = read_box(m, lower, upper).state == OCCUPIED
        transform = timed(lambda: _signed_transform(obstacle))
    peers = _peers(m, points, starts, ways)
    if "OctoMap" not in missing_peers():
        box = (lower, upper) if box_voxels <= LARGEST_BOX else None
        asked |= _octomap_asked(octree_of(m), box, max_distance_m)
    free = points[m.state(points) == FREE][:ASKED]
    calls = {
        name: (_call(asking, free, ways), _call(asking, free[:FEW], ways)) for name, asking in asked.items()
    }
    id = m.add_keyframe(last.depth_m, last.T_world_camera, last.camera, last.name)
    m.renew([id])
    changed: list[int] = []
    update = timed(lambda: changed.append(distances.update()))
    progress(len(frames))
    return QueryRow(
        m.voxel_size, len(frames), rates, build, update, changed[0], distances.bytes / 1e6, transform,
        box_voxels, peers, calls,
    )  # fmt: skip


def fastest(call: Asked, tries: int = _TRIES) -> Seconds:
    """How long the fastest of some calls takes, after one that does not count."""
    call()
    return min((timed(call) for _ in range(tries)), key=lambda seconds: seconds.wall)


def _call(asking: Asking, places: Points, ways: Points) -> Seconds:
    return fastest(lambda: asking(places, ways[: len(places)]), tries=4 * _TRIES)


def _extent(m: MRFMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two corners around all bricks with voxels, in metres."""
    centres, _ = m.voxels(0.0)
    half = 0.5 * m.voxel_size
    return centres.min(axis=0) - half, centres.max(axis=0) + half


def _signed_transform(obstacle: NDArray[np.bool_]) -> None:
    distance_transform_edt(~obstacle)
    distance_transform_edt(obstacle)


def _peers(
    m: MRFMap, points: NDArray[np.float64], starts: NDArray[np.float64], ways: NDArray[np.float64]
) -> dict[str, Rate]:
    """Rates of OctoMap and Open3D on the same map, as far as they are installed."""
    missing, rates = missing_peers(), {}
    if "OctoMap" not in missing:
        tree = octree_of(m)
        rates["OctoMap's search"] = Rate(len(points), fastest(lambda: tree.getLabels(points), tries=2))
    if "Open3D" not in missing:
        with tempfile.TemporaryDirectory() as folder:
            export_map(m, Path(folder) / "map.ply", ExportOptions(cubes=True, cells=False))
            cast = _open3d_rays(Path(folder) / "map.ply", starts, ways)
        rates["Open3D's rays"] = Rate(len(starts), fastest(cast))
    return rates


def octree_of(m: MRFMap) -> Any:
    """OctoMap's tree of the same map."""
    tree = library("pyoctomap", "OctoMap's queries need", "bench").OcTree(m.voxel_size)
    with tempfile.TemporaryDirectory() as folder:
        export_map(m, Path(folder) / "map.bt", ExportOptions(cells=False))
        tree.readBinary(str(Path(folder) / "map.bt"))
    return tree


def _octomap_asked(
    tree: Any, box_m: tuple[Points, Points] | None, max_distance_m: float
) -> dict[str, Asking]:
    """The same questions to OctoMap. Rays and distances are one call each: it has none for many."""
    asked: dict[str, Asking] = {
        "OctoMap's search": lambda places, ways: tree.getLabels(places),
        "OctoMap's rays": lambda places, ways: octomap_rays(tree, places, ways, stop=False),
        "OctoMap's rays that the unknown stops": lambda places, ways: octomap_rays(
            tree, places, ways, stop=True
        ),
    }
    if box_m is not None:
        tree.dynamicEDT_generate(max_distance_m, *box_m, False)
        tree.dynamicEDT_update(True)
        asked["OctoMap's distances"] = lambda places, ways: [
            tree.dynamicEDT_getDistance(place) for place in places
        ]
    return asked


def octomap_rays(tree: Any, places: Points, ways: Points, stop: bool) -> list[bool]:
    """Whether OctoMap's rays meet something within RANGE_M."""
    end = np.empty(3)
    return [
        tree.castRay(place, way, end, ignoreUnknownCells=not stop, maxRange=RANGE_M)
        for place, way in zip(places, ways, strict=True)
    ]


def _open3d_rays(path: Path, starts: NDArray[np.float64], ways: NDArray[np.float64]) -> Asked:
    """Function that asks Open3D where rays meet the triangles of cubes."""
    open3d = library("open3d", "Open3D's rays need", "bench")
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(open3d.io.read_triangle_mesh(str(path))))
    unit = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    rays = open3d.core.Tensor(np.concatenate([starts, unit], axis=1).astype(np.float32))
    return lambda: scene.cast_rays(rays)


def measure_queries(run: BenchRun) -> Measured:
    """Points, balls and rays a second that a planner can ask about, and the cost of distances."""
    for name in missing_peers():
        run.leave_out(name)
    rows = [bench_queries(run.frames, config, advance) for config, advance in run.each_size()]
    return query_tables(rows, run.title), [row.to_json() for row in rows], None


_QUERY_NAMES = {
    "balls": "balls, by clearance",
    "rays": "rays, to occupied voxels",
    "rays of an image": "rays of an image, by render_depth",
}
"""Of the rates, those that are called otherwise here."""


def query_tables(rows: Sequence[QueryRow], title: str) -> list[Table]:
    """Million queries a second, and the seconds that distances take beside SciPy's transform."""
    return [_rate_table(rows, title), _call_table(rows), _distance_table(rows)]


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


def _call_table(rows: Sequence[QueryRow]) -> Table:
    table = size_columns(
        f"A call of {ASKED:,}, ms of processors' time (of {FEW}: what the call itself takes)",
        [row.voxel_size for row in rows],
    )
    for name in rows[0].calls:
        table.add_row(name, *[_call_ms(row.calls.get(name)) for row in rows])
    table.caption = (
        f"Places where the map is free, rays of up to {RANGE_M:g} m. OctoMap is asked for all states at "
        "once, for rays and distances one by one, from Python."
    )
    table.caption_justify = "left"
    return table


def _call_ms(call: tuple[Seconds, Seconds] | None) -> str:
    return "-" if call is None else f"{1e3 * call[0].cpu:.2f} ({1e3 * call[1].cpu:.2f})"


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
