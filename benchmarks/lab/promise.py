"""`python -m benchmarks.lab promise`: whether free space is as free as it is promised, and what that costs.

Maps are calibrated by every fifth view (every third of the coffin scene's twelve), which they have not seen,
and compared with the truth: a voxel contains matter if a surface passes through it and a clean ray ends
there, and is free if a clean ray crosses it and no surface touches it. The room with thin things is that of
thin.py. Of recordings nothing is known but the bounds that they lead to: the lowest of all scenes are the
default table of queries/free.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.lab.cells import _house, _room
from benchmarks.thin import configured, keys_of, truth_of
from benchmarks.thin_rooms import SCENES, depth_camera, take_views
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.evaluation.experiments.contenders import Contender, lidar_mrf, mrf
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.scenes import (
    Scene,
    SceneView,
    coffin_scene,
    house_scene,
    kitchen_scene,
    lidar_scene,
    off_the_grid,
    turned,
)
from taichi_mrf.evaluation.free_space import calibrate_free
from taichi_mrf.evaluation.occupancy_truth import SeenVoxels, occupancy_truth, seen_voxels
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.queries.free import LEVELS as ALL_LEVELS
from taichi_mrf.queries.free import NEVER, FreePromise, states_at
from taichi_mrf.queries.known_bricks import known_bricks
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.sensor.camera import pinhole
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.marks import marked_voxels

LEVELS = (0.9, 0.95, 0.99)
LEAST_SURE = 1.0
"""Nats below a level's bound in which its least sure voxels are."""

NEAR_M = 1.0
"""Clearance is compared in free voxels that are so near to an obstacle."""

Keys = NDArray[np.int64]


@dataclass(frozen=True)
class Truth:
    """Keys of the voxels that contain matter and are measured, and of those that are free and crossed."""

    matter: Keys
    free: Keys


def run_promise(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Coverage and cost of each scene and voxel size, and the bounds."""
    rows: list[list[Entry]] = []
    bounds: list[list[Entry]] = []
    for size in experiment.voxel_sizes:
        places = {name: make for name, make in _places(experiment).items() if experiment.wants(name)}
        for number, (name, make) in enumerate(places.items()):
            experiment.report(f"{name}, {100 * size:g} cm", number, len(places))
            m, frames, truth = make(size)
            promise = calibrate_free(m, frames)
            if promise is None:
                continue
            bounds.append([name, f"{100 * size:g} cm", *promise.bound.tolist()])
            if truth is not None:
                rows += [[name, f"{100 * size:g} cm", *row] for row in _judge(m, promise, truth)]
    columns = ["scene", "voxels", "level", "bound", "free without matter", "least sure without matter",
               "held, worst", "held, best", "truly free refused", "clearance lost, cm"]  # fmt: skip
    notes = [
        "Without matter: of the voxels that are free at the level and whose truth is known; the least sure "
        "are those within a nat of the level's bound. Held: without a measured end, in held-out frames. "
        "Refused: of the truly free voxels that the map calls free. Clearance: distance to the nearest "
        "occupied voxel less that to the nearest one that is occupied or refused, of voxels up to "
        f"{NEAR_M:g} m from the former.",
    ]
    tables = [
        Table("promise", "Free space with a promise", columns, rows, notes),
        Table("bounds", "Bounds of levels, nats",
              ["scene", "voxels", *(f"{100 * level:g}%" for level in ALL_LEVELS)], bounds,
              [f"A level that cannot be promised has {NEVER:g}."]),
    ]  # fmt: skip
    return tables, [path for table in tables for path in write_table(experiment.out, table)]


def _places(
    experiment: Experiment,
) -> dict[str, Callable[[float], tuple[OccupancyMap, list[Frame], Truth | None]]]:
    seed = experiment.seeds[0]
    house, room = _house(experiment), _room(experiment, frames=50)
    whole = house_scene(experiment.data, seed)
    kitchen, building = kitchen_scene(experiment.data), lidar_scene(experiment.data)
    places: dict[str, Callable[[float], tuple[OccupancyMap, list[Frame], Truth | None]]] = {
        "house, turned": lambda size: _by_mesh(*turned(whole, house.mesh), size),
        "room": lambda size: _by_mesh(room.scene, room.mesh, size),
        "room, turned": lambda size: _by_mesh(*turned(room.scene, room.mesh), size),
        "coffin scene": lambda size: _coffin(off_the_grid(coffin_scene(experiment.data, seed)), size),
        "kitchen": lambda size: (*_mapped(kitchen, 5, size), None),
        "building by lidar": lambda size: (*_mapped(building, 5, size, lidar_mrf()), None),
    }
    for name in ("room", "fence", "clutter"):
        places[f"thin things: {name}"] = lambda size, name=name: _thin(name, seed, size)  # type: ignore[misc]
    return places


def _split(count: int, each: int) -> set[int]:
    return {i for i in range(count) if i % each == each // 2}


def _mapped(
    scene: Scene, each: int, size: float, contender: Contender | None = None
) -> tuple[OccupancyMap, list[Frame]]:
    out = _split(len(scene.views), each)
    m = (contender or mrf()).make(scene, size)
    frames = []
    for i, view in enumerate(scene.views):
        camera = view.camera or scene.camera
        if i in out:
            frames.append(Frame(view.measured_m, view.T_world_camera, camera, float(i), view.name))
        else:
            m.add_keyframe(view.measured_m, view.T_world_camera, camera, view.name)
    m.infer()
    return m, frames


def _by_mesh(scene: Scene, mesh: TriangleMesh, size: float) -> tuple[OccupancyMap, list[Frame], Truth]:
    truth = occupancy_truth(mesh, *_clean(scene.views), scene.pinhole, size)
    keys = (keys_of(v.astype(np.int64)) for v in (truth.occupied(), truth.free()))
    return *_mapped(scene, 5, size), Truth(*keys)


def _coffin(scene: Scene, size: float) -> tuple[OccupancyMap, list[Frame], Truth]:
    """Without a mesh: matter is where clean rays end."""
    crossed, ended = _keys(seen_voxels(*_clean(scene.views), scene.pinhole, size))
    return *_mapped(scene, 3, size), Truth(ended, np.setdiff1d(crossed, ended))


def _thin(name: str, seed: int, size: float) -> tuple[OccupancyMap, list[Frame], Truth]:
    scene, kinect = SCENES[name](seed), SensorConfig()
    sensor = depth_camera(kinect.sigma, kinect.max_depth)
    views = take_views(scene, sensor, 50, seed)
    out, frames = _split(len(views), 5), []
    m = create_map(configured("mrf", size, sensor, False), sensor.camera)
    for i, view in enumerate(views):
        frame = Frame(view.depth_m, view.T_world_camera, sensor.camera, float(i), f"view {i}")
        if i in out:
            frames.append(frame)
        else:
            m.add(frame)
    m.infer()
    clean = [np.where(view.depth_m > 0, view.true_m, 0).astype(np.float32) for view in views]
    crossed, ended = _keys(
        seen_voxels(clean, [v.T_world_camera for v in views], pinhole(sensor.camera, name), size)
    )
    matter = truth_of(scene, sensor, views, size).matter
    return m, frames, Truth(np.intersect1d(matter, ended), np.setdiff1d(crossed, matter))


def _clean(views: Sequence[SceneView]) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float64]]]:
    return [view.true_m for view in views], [view.T_world_camera for view in views]


def _keys(seen: SeenVoxels) -> tuple[Keys, Keys]:
    crossed, ended = (
        keys_of(marked_voxels(marks, seen.window).astype(np.int64)) for marks in (seen.crossed, seen.ended)
    )
    return crossed, ended


def _judge(m: Any, promise: FreePromise, truth: Truth) -> list[list[Entry]]:
    bricks = known_bricks(m).astype(np.int64)
    inner = np.stack(np.unravel_index(np.arange(VOXELS), (BRICK,) * 3), axis=1)
    voxels = (bricks[:, None] * BRICK + inner).reshape(-1, 3)
    log_odds, state = states_at(m.decided, (voxels + 0.5) * m.voxel_size)
    occupied, free = voxels[state == OCCUPIED], state == FREE
    voxels, log_odds = voxels[free], log_odds[free]
    keys = keys_of(voxels)
    matter, empty = np.isin(keys, truth.matter), np.isin(keys, truth.free)
    judged = matter | empty
    reach = NEAR_M / m.voxel_size
    draw = np.random.default_rng(0).permutation(np.flatnonzero(empty))[:50_000]
    before, _ = cKDTree(occupied).query(voxels[draw], distance_upper_bound=reach)
    near = draw[np.isfinite(before)]
    rows: list[list[Entry]] = []
    for level in LEVELS:
        i = int(np.argmin(np.abs(promise.levels - level)))
        most = promise.bound[i]
        called = log_odds < most
        refused = np.concatenate([occupied, voxels[~called]])
        after, _ = cKDTree(refused).query(voxels[near])
        least_sure = called & (log_odds >= most - LEAST_SURE) & judged
        lost = float(np.mean(before[np.isfinite(before)] - after)) * m.voxel_size
        rows.append([f"{level:.0%}", float(most), 1 - float(matter[called & judged].mean()),
                     1 - float(matter[least_sure].mean()) if least_sure.any() else float("nan"),
                     float(promise.held_least[i]), float(promise.held_most[i]),
                     float((~called[empty]).mean()), 100 * lost])  # fmt: skip
    return rows
