"""What a map says of thin things, in rooms whose truth is known: legs, posts, cables, wires, leaves, edges.

    python -m benchmarks.thin --room room --method mrf mrf:pass_through=0.1 log_odds wavemap

Views are made by closed forms (thin_shapes.py, thin_rooms.py), with the noise that the map is told. Of each
kind of thing, those voxels count that it has a point in and in which ten or more measurements of it end.
The table also gives the pixels of held-out views whose first surface is of that kind, and the collision of a
ball on a path straight through a thing, and past it. The lines below it are about the whole map.
"""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
import yaml
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.lab.early import too_early
from benchmarks.thin_paths import BALL_M, Crossing, crossings
from benchmarks.thin_rooms import SCENES, Scene, Sensor, View, depth_camera, spinning_lidar, take_views
from benchmarks.thin_shapes import Array, voxels_of
from taichi_mrf import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Arch, Config, SensorConfig
from taichi_mrf.config.values import from_dict
from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH
from taichi_mrf.datasets.recorded_noise import SHORT_RAYS_FLOOR
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system import runtime

LEAST_ENDS = 10
"""Measurements that end in a voxel which the map should know."""

TOLERANCE = 1.5
"""Voxels by which a rendered depth may be off."""

_OFFSET = 1 << 20


@dataclass(frozen=True)
class Options:
    """What to measure."""

    room: tuple[str, ...] = ("room",)
    """Of room, fence, clutter and yard (lidar only), or "all"."""

    sensor: Annotated[str, tyro.conf.arg(metavar="camera|lidar")] = "camera"
    """A depth camera of 320 x 240, or a lidar of 16 rings (32 in the yard)."""

    width: int = 320
    """Pixels of a depth camera's row; its columns have three quarters as many."""

    voxel_size: tuple[float, ...] = (0.05,)
    """Metres."""

    method: tuple[str, ...] = ("mrf", "log_odds", "wavemap")
    """Methods, each with parameters of its section or another: mrf:pass_through=0.1,sensor.max_depth=8"""

    views: int = 40
    """Views to map."""

    held_out: int = 6
    """Further views, spread over the walk."""

    seed: int = 0
    """Of places, noise and leaves."""

    json: Path | None = None
    """Also write all figures to this file."""

    arch: Arch = "auto"
    """Backend."""


@dataclass(frozen=True)
class Truth:
    """What a scene's voxels hold. Voxels are keys (:func:`keys_of`), sorted."""

    matter: NDArray[np.int64]
    """Those that anything has a point in."""

    measured: dict[str, NDArray[np.int64]]
    """By kind, those that a thing of it has a point in and in which ten of its measurements end."""

    all_measured: NDArray[np.int64]
    """Those of matter in which ten measurements of anything end."""


@dataclass(frozen=True)
class Kind:
    """Figures of one kind of thing. Shares are NaN where nothing was to be measured."""

    voxels: int
    occupied: float
    free: float
    unknown: float
    pixels: int
    right: float
    through: float
    unanswered: float
    paths_through: int
    hit: float
    """Share of the paths through a thing whose collision has a probability of at least .5."""

    hit_mean: float
    paths_past: int
    cleared: float
    """Share of the paths past a thing whose collision has a probability of at most .05."""

    past_mean: float


@dataclass(frozen=True)
class Result:
    """Figures of one map."""

    room: str
    sensor: str
    voxel_size: float
    method: str
    seconds: float
    occupied: int
    precision: float
    """Share of the occupied voxels that anything has a point in; walls are 10 cm thick."""

    recall: float
    furthest: int
    """Voxels from the furthest occupied voxel to matter, the largest of the three axes' differences."""

    beyond_one: float
    """Share of the occupied voxels that are further than one from matter."""

    precision_inside: float
    """The precision without the voxels that lie wholly behind the faces of walls, where nothing is seen."""

    furthest_inside: int
    beyond_one_inside: float

    blocked: float
    """Share of the held-out rays that enter an occupied voxel in front of what they measured."""

    kinds: dict[str, Kind]


def keys_of(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each voxel (N, 3), (N,)."""
    x, y, z = (voxels + _OFFSET).T
    return (x << 42) | (y << 21) | z


def voxels_at(points_m: Array, voxel_size: float) -> NDArray[np.int64]:
    """The voxels of points (N, 3), (N, 3)."""
    return np.floor(points_m / voxel_size).astype(np.int64)


def truth_of(scene: Scene, sensor: Sensor, views: list[View], voxel_size: float) -> Truth:
    """The voxels of everything, and those that the views measure."""
    ends = keys_of(voxels_at(np.concatenate([v.points(sensor.camera) for v in views]), voxel_size))
    of_thing = np.concatenate([view.thing[view.depth_m > 0] for view in views])
    kinds = np.array([thing.kind for thing in scene.things])
    touched: dict[str, list[NDArray[np.int64]]] = {}
    for thing in scene.things:
        touched.setdefault(thing.kind, []).append(keys_of(voxels_of(thing.shape, voxel_size)))
    matter = np.unique(np.concatenate([keys for each in touched.values() for keys in each]))
    measured = {
        kind: np.intersect1d(_often(ends[kinds[of_thing] == kind]), np.concatenate(keys))
        for kind, keys in touched.items()
    }
    return Truth(matter, measured, np.intersect1d(_often(ends), matter))


def _often(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    found, count = np.unique(keys, return_counts=True)
    return found[count >= LEAST_ENDS]


def configured(method: str, voxel_size: float, sensor: Sensor, lidar: bool) -> Config:
    """The parameters that ``taichi-mrf map`` would take for a recording of the sensor, and a method's own."""
    name, _, settings = method.partition(":")
    recorded = {"pass_through": LIDAR_PASS_THROUGH} if lidar else {"outlier_floor": SHORT_RAYS_FLOOR}
    values: dict[str, Any] = {"method": name, "voxel_size": voxel_size, "inference": recorded}
    values["sensor"] = asdict(SensorConfig(sigma=sensor.sigma, max_depth=sensor.max_depth))
    section = METHODS[name].section if name in METHODS else name
    for setting in filter(None, settings.split(",")):
        path, _, value = setting.partition("=")
        *outer, last = path.split(".")
        values.setdefault(outer[0] if outer else section, {})[last] = yaml.safe_load(value)
    return from_dict(Config, values, method)


def map_views(config: Config, sensor: Sensor, views: list[View]) -> OccupancyMap:
    """A finished map."""
    m = create_map(config, sensor.camera)
    for i, view in enumerate(views):
        m.add_keyframe(view.depth_m, view.T_world_camera, sensor.camera, f"view {i}", float(i))
    m.infer()
    return m


def measure(
    m: OccupancyMap,
    scene: Scene,
    sensor: Sensor,
    truth: Truth,
    held_out: list[View],
    paths: list[Crossing],
) -> dict[str, Any]:
    """The fields of Result that come from the map."""
    centres_m = m.voxels(0.0)[0]
    occupied = voxels_at(centres_m[m.state(centres_m) == OCCUPIED], m.voxel_size)
    keys = keys_of(occupied)
    real = np.isin(keys, truth.matter)
    apart = np.zeros(len(keys), int)
    if not real.all():
        tree = cKDTree(_unpacked(truth.matter))
        apart[~real] = np.rint(tree.query(occupied[~real], p=np.inf)[0]).astype(int)
    centres_m = (occupied.astype(np.float64) + 0.5) * m.voxel_size
    inside = scene.inner.touched_by(centres_m, 0.5 * m.voxel_size)
    pixels = _held_out_pixels(m, scene, sensor, held_out)
    return {
        "occupied": len(keys),
        "precision": _mean(real),
        "recall": _mean(np.isin(truth.all_measured, keys)),
        "furthest": int(apart.max(initial=0)),
        "beyond_one": _mean(apart > 1),
        "precision_inside": _mean(real[inside]),
        "furthest_inside": int(apart[inside].max(initial=0)),
        "beyond_one_inside": _mean(apart[inside] > 1),
        "blocked": _blocked(m, sensor, held_out),
        "kinds": {
            kind: _kind(m, voxels, pixels[kind], [path for path in paths if path.kind == kind])
            for kind, voxels in truth.measured.items()
        },
    }


def _unpacked(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - _OFFSET


def _mean(values: NDArray[Any]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _kind(m: OccupancyMap, keys: NDArray[np.int64], off_m: Array, paths: list[Crossing]) -> Kind:
    """``keys`` are its voxels, ``off_m`` rendered less true depth of its pixels, NaN without an answer."""
    state = m.state((_unpacked(keys) + 0.5) * m.voxel_size) if len(keys) else np.zeros(0, np.int8)
    most_m = TOLERANCE * m.voxel_size
    through, past = (
        m.path_collision(np.stack(which), BALL_M) if which else np.zeros(0)
        for which in (
            [path.through_m for path in paths if path.through_m is not None],
            [path.past_m for path in paths if path.past_m is not None],
        )
    )
    return Kind(
        voxels=len(keys),
        occupied=_mean(state == OCCUPIED),
        free=_mean(state == FREE),
        unknown=_mean(state == UNKNOWN),
        pixels=len(off_m),
        right=_mean(np.abs(off_m) <= most_m),
        through=_mean(off_m > most_m),
        unanswered=_mean(np.isnan(off_m)),
        paths_through=len(through),
        hit=_mean(through >= 0.5),
        hit_mean=_mean(through),
        paths_past=len(past),
        cleared=_mean(past <= 0.05),
        past_mean=_mean(past),
    )


def _held_out_pixels(m: OccupancyMap, scene: Scene, sensor: Sensor, views: list[View]) -> dict[str, Array]:
    """By kind, rendered less true depth of the pixels that see it first, (n,), NaN without an answer."""
    off_m, of_thing = [], []
    for view in views:
        rendered_m, seen = m.render_depth(sensor.camera, view.T_world_camera), view.thing >= 0
        off_m.append(rendered_m[seen] - view.true_m[seen])
        of_thing.append(view.thing[seen])
    off, kinds = np.concatenate(off_m), np.array([thing.kind for thing in scene.things])
    kind = kinds[np.concatenate(of_thing)]
    return {name: off[kind == name] for name in np.unique(kinds)}


def _blocked(m: OccupancyMap, sensor: Sensor, views: list[View]) -> float:
    frames = [Frame(view.depth_m, view.T_world_camera, sensor.camera, 0.0, "held out") for view in views]
    blocked = [too_early(m, frame, sensor.sigma_at(frame.depth_m.astype(float)))[0] for frame in frames]
    return _mean(np.concatenate(blocked))


def print_result(result: Result) -> None:
    """A table of the kinds, and the figures of the whole map."""
    print(f"\n{result.room}, {result.sensor}, {100 * result.voxel_size:g} cm: {result.method}")
    print(
        f"{'kind':>11} {'voxels':>7} {'occ.':>5} {'free':>5} {'unkn.':>5} | {'pixels':>7} {'right':>5} "
        f"{'thru':>5} {'none':>5} | {'through':>7} {'>=.5':>5} {'mean':>5} | "
        f"{'past':>4} {'<=.05':>5} {'mean':>5}"
    )
    for name, k in result.kinds.items():
        print(
            f"{name:>11} {k.voxels:7d} {k.occupied:5.2f} {k.free:5.2f} {k.unknown:5.2f} | {k.pixels:7d} "
            f"{k.right:5.2f} {k.through:5.2f} {k.unanswered:5.2f} | {k.paths_through:7d} {k.hit:5.2f} "
            f"{k.hit_mean:5.2f} | {k.paths_past:4d} {k.cleared:5.2f} {k.past_mean:5.2f}"
        )
    print(f"{result.occupied} occupied, recall {result.recall:.3f}")
    print(
        f"precision {result.precision:.3f}, furthest from matter {result.furthest} voxels, "
        f"{result.beyond_one:.4f} further than one"
    )
    print(
        f"inside the walls {result.precision_inside:.3f}, {result.furthest_inside} voxels, "
        f"{result.beyond_one_inside:.4f}"
    )
    print(f"held-out rays blocked {result.blocked:.3f}; mapped in {result.seconds:.1f} s", flush=True)


def main() -> None:
    """Print the tables of all combinations, and write them."""
    options = tyro.cli(Options, description=__doc__)
    runtime.init(options.arch)
    lidar = options.sensor == "lidar"
    rooms = [name for name in SCENES if lidar or name != "yard"] if "all" in options.room else options.room
    results = []
    for name in rooms:
        scene = SCENES[name](options.seed)
        kinect = SensorConfig()
        sensor = (
            spinning_lidar(name == "yard")
            if lidar
            else depth_camera(kinect.sigma, kinect.max_depth, options.width)
        )
        views = take_views(scene, sensor, options.views + options.held_out, options.seed)
        out = set(np.linspace(0, len(views) - 1, options.held_out + 2).astype(int)[1:-1].tolist())
        mapped, held_out = (
            [v for i, v in enumerate(views) if (i in out) == which] for which in (False, True)
        )
        paths = crossings(scene, sensor, mapped)
        for voxel_size in options.voxel_size:
            truth = truth_of(scene, sensor, mapped, voxel_size)
            for method in options.method:
                start = time.perf_counter()
                m = map_views(configured(method, voxel_size, sensor, lidar), sensor, mapped)
                seconds = time.perf_counter() - start
                figures = measure(m, scene, sensor, truth, held_out, paths)
                results.append(Result(name, options.sensor, voxel_size, method, seconds, **figures))
                print_result(results[-1])
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(r) for r in results], indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
