"""A window that follows the camera, in a corridor that the camera walks to its end and back.

Maps with a window of 10 m are compared with maps of the same keyframes that are in memory as a whole: how
much memory they take on the way, and whether the map that is found again at the start is the same.
"""

import shutil
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.lab.submaps.equality import compare
from taichi_mrf import ChunkedMap, MRFMap, open_dataset
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.mapping.selection import surplus
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEYFRAMES = 1000
ROOMS = 40
SCENE = f"synthetic:corridor?rooms={ROOMS}&width=64&height=48"
WINDOW_M = 10.0
KEPT = 24
EVERY = 100
"""Keyframes from one row of the table to the next."""

WINDOW, FEW, FROZEN, ALL = "window", f"window, {KEPT} kept", "no window", "no window, none frozen"
"""The maps: with a window; that also freezes keyframes beyond a number; without a window, which freezes the
keyframes that the first does; and one that can still change all keyframes."""


def run_window(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Memory on the way, and the share of equal voxels at its end."""
    count = min(KEYFRAMES, experiment.limit or KEYFRAMES)
    memory: list[list[Entry]] = []
    equal: list[list[Entry]] = []
    paths: list[Path] = []
    for number, voxel_size in enumerate(experiment.voxel_sizes):
        size = f"{voxel_size * 100:g} cm"
        experiment.report(size, number, len(experiment.voxel_sizes))
        key = f"{SCENE} | {count} keyframes, there and back | window of {WINDOW_M:g} m | {voxel_size:g} m"
        result = experiment.ledger.result(key, lambda v=voxel_size: _measured(experiment, v, count))  # type: ignore[misc]
        memory += [[size, *row] for row in result["memory"]]
        equal += [
            [size, name, e["voxels"], 100 * e["within"], 100 * e["same_state"], e["largest"]]
            for name, e in result["equality"].items()
        ]
        path = experiment.out / f"window_{voxel_size * 1000:g}mm.png"
        with atomic_path(path) as part:
            window_figure(result).savefig(part, format="png", dpi=110)
        paths.append(path)
    tables = [
        Table(
            "window_memory",
            f"MB in memory: {count} keyframes in a corridor of {ROOMS} rooms, there and back",
            ["voxels", "keyframe", WINDOW, FEW, FROZEN, ALL, "keyframes in the window", "chunks on disk",
             "MB on disk"],
            memory,
            ["MB of voxels, messages, images and scratch."],
        ),
        Table(
            "window_equality",
            "The map in the folder at the end, against maps of the same keyframes in memory",
            ["voxels", "against", "compared", "within 0.02 (%)", "same state (%)", "largest difference"],
            equal,
            [f"'{FROZEN}' freezes the same keyframes at the same moments; '{ALL}' sweeps all of them again.",
             "'in full' infers the last one anew: what the order of sweeps alone changes."],
        ),
    ]  # fmt: skip
    return tables, [*[path for table in tables for path in write_table(experiment.out, table)], *paths]


def walked(count: int) -> Iterator[Frame]:
    """The corridor from end to end and back, with other noise."""
    there = (count + 1) // 2
    for seed, order in enumerate((range(there), range(count - there - 1, -1, -1))):
        dataset = open_dataset(f"{SCENE}&frames={there}&seed={seed}", color=False)
        yield from map(dataset.read, order)


def _measured(experiment: Experiment, voxel_size: float, count: int) -> Result:
    folder = experiment.out / "window"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    volume = VolumeConfig(window_m=WINDOW_M)
    maps = {
        name: MRFMap(voxel_size, volume=volume if name in (WINDOW, FEW) else None)
        for name in (WINDOW, FEW, FROZEN, ALL)
    }
    window = maps[WINDOW].window
    few = maps[FEW].window
    assert window is not None
    assert few is not None
    window.park_in(folder / "map_window.zarr")
    few.park_in(folder / "few_window.zarr")
    memory = []
    for number, frame in enumerate(walked(count), start=1):
        for name, m in maps.items():
            id = m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
            if name == FROZEN:
                for old in maps[WINDOW].frozen.keys() & m.keyframes.keys():
                    m.freeze_keyframe(old)
            m.renew([id])
            if name == FEW:
                for old in surplus(m, id, KEPT):
                    m.freeze_keyframe(old)
        if number % EVERY == 0 or number == count:
            experiment.report(f"{voxel_size * 100:g} cm, keyframe {number}", number, count)
            sizes = [m.statistics().memory_mb for m in maps.values()]
            live = len(maps[WINDOW].keyframes)
            memory.append([number, *sizes, live, len(window.parked), _megabytes(folder / "map_window.zarr")])
    maps[WINDOW].save(folder / "map.npz")
    whole = ChunkedMap.open(folder / "map_window.zarr")
    equality = {name: asdict(compare(maps[name], whole)) for name in (FROZEN, ALL)}
    maps[ALL].infer()
    equality[f"{ALL}, in full"] = asdict(compare(maps[ALL], whole))
    return {"memory": memory, "equality": equality}


def _megabytes(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def window_figure(result: Result) -> "Figure":
    """Megabytes of each map over the keyframes."""
    figure = new_figure(7.0, 4.0)
    axes = figure.subplots()
    keyframes = [row[0] for row in result["memory"]]
    for column, name in enumerate((WINDOW, FEW, FROZEN, ALL), start=1):
        axes.plot(keyframes, [row[column] for row in result["memory"]], label=name)
    axes.set(xlabel="keyframes", ylabel="MB in memory", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
