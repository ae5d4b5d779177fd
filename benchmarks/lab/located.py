"""`python -m benchmarks.lab located`: where a recording of today lies in the map of yesterday.

Recordings are cut in two: one part makes the map, ten frames of the other, turned and moved at random, are
searched for in it, and where they are found is compared with where they were taken. Recordings of other
places, and mirror images of recordings, must be refused: each is searched for from another frame on, as
`map --onto` does, in up to six stretches, which confirm each other; so are whole second parts. Held-out
frames judge what is mapped in a place that was found.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from taichi_mrf.alignment.locate_recording import LocatedRecording
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.config.schema import Config
from taichi_mrf.config.values import overridden
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.derived import Derived, chosen
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.held_out import pooled_depth_error, surface_depth
from taichi_mrf.evaluation.tables import Entry, Table, as_csv, write_table
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.mapping.onto import Placed, locate, placed_in, whole_map
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.memory import peak_memory_mb, reset_peak_memory

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"

RIGHT_M, RIGHT_DEGREES = 0.05, 2.0
"""A recording is located up to here."""

WRONG_M, WRONG_DEGREES = 0.2, 5.0
"""Further away the place is a wrong one."""

OVERLAP = 1 / 3
"""Share of what the frames see that the map has to show, or they were taken elsewhere."""

KITCHEN, HOUSE, ROOM = "seven_scenes_redkitchen", "house_livingroom", "synthetic:room?frames=120"
BUILDING, STREET = "lidar_building", "stereo_kitti/KITTI_sequence_1"
ROOMS = {
    "kitchen": KITCHEN,
    "house": HOUSE,
    "ICL-NUIM": "icl_nuim_livingroom_traj2",
    "room": ROOM,
    "corridor": "synthetic:corridor?frames=240&width=160&height=120",
    "coffin scene": "coffin_world",
}
UNSEEN_HALVES = {"house", "room", "street by stereo"}
"""Their second halves show little that the first ones do."""

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])

COPIES = {"room", "corridor"}
"""The corridor's rooms are the room, each without one piece of its furniture and with another table."""

LIDARS = {
    "building": BUILDING,
    "OSF 1": "ouster/osf_fw_3.2_10scans.osf",
    "OSF 2": "ouster/OS-1-128_v2.3.0_1024x10_lb_n3.osf",
    "PCAP": "ouster/OS-0-128-U1_v2.3.0_1024x10.pcap",
    "ROC scans": "la3dm_structured",
}
HALVES = (
    ("kitchen", KITCHEN, 1, 20),
    ("house", HOUSE, 1, 11),
    ("room", ROOM, 1, 10),
    ("building by lidar", BUILDING, 4, 14),
    ("street by stereo", STREET, 4, 10),
)
"""Scene, source, voxels in units of the experiment's, and tries."""


@dataclass(frozen=True)
class Yesterday:
    """A map of some ``frames`` of a recording, all if None."""

    source: str
    voxel_size: float
    frames: Sequence[int] | None = None

    @cached_property
    def map(self) -> MRFMap:
        """The map."""
        dataset = open_dataset(self.source)
        settings = with_recorded_noise(overridden(Config(), {"voxel_size": self.voxel_size}, ""), dataset)
        m = create_map(settings, dataset.camera)
        assert isinstance(m, MRFMap)
        for index in self.frames or range(len(dataset)):
            m.add(dataset.read(index))
        return m

    def search(self, today: Dataset, seed: Sequence[int]) -> Result:
        """Where frames are found that have been moved away, how far that is from the truth if they are of the
        same recording, and what it takes."""
        m, away = self.map, moved_away(today, seed)
        reset_peak_memory()
        before_mb, start = peak_memory_mb() or 0.0, time.process_time()
        found = locate(m, away)
        seconds, mb = time.process_time() - start, (peak_memory_mb() or 0.0) - before_mb
        answer = {"seconds": seconds, "mb": mb, "reason": found.reason, "through": found.through}
        if found.T_map_recording is None:
            return answer
        middle = today.pose(list(today.frame_names).index(found.frames[len(found.frames) // 2]))
        off_rad, off_m = tangent_norms(middle, found.T_map_recording @ away.T_map_recording @ middle)
        return answer | {
            "off_m": off_m,
            "off_degrees": float(np.degrees(off_rad)),
            "sigma_m": found.sigma_m,
            "sigma_degrees": float(np.degrees(found.sigma_rad)),
        }

    def shows(self, today: Dataset) -> Result:
        """The share of what frames measure that lies within a voxel, and 10 cm, of the map's surface."""
        surface = whole_map(self.map).surface.planes()
        shown, tree = [], cKDTree(surface.points_m)
        for frame in (today.read(i) for i in range(len(today))):
            points = points_of(frame, self.map.sensor.max_depth)
            away_m, nearest = tree.query(points, distance_upper_bound=2 * self.voxel_size)
            met = np.isfinite(away_m)
            rows = nearest[met]
            height_m = np.abs(((points[met] - surface.points_m[rows]) * surface.normals[rows]).sum(axis=1))
            shown.append((height_m < min(0.1, self.voxel_size)).sum() / len(points))
        return {"share": float(np.mean(shown))}


def moved_away(dataset: Dataset, seed: Sequence[int]) -> Placed:
    """A recording in a world of its own: under any turn, and up to 5 m along each axis."""
    rng, T = np.random.default_rng(seed), np.eye(4)
    T[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    T[:3, 3] = rng.uniform(-5, 5, 3)
    here, name = LocatedRecording(T), dataset.name
    return Placed(
        name, dataset.camera, source=dataset, located=here, prefix="", later_s=0.0, map_origin_m=np.zeros(3)
    )


class Mirrored(Derived):
    """The mirror image of a recording by a camera."""

    @staticmethod
    def of(dataset: Dataset) -> "Mirrored":
        """Left and right are exchanged."""
        return Mirrored(dataset.name, _mirrored(dataset.camera), source=dataset)

    def pose(self, index: int) -> Pose:
        """The source's, in the mirror."""
        return MIRROR @ self.source.pose(index) @ MIRROR

    def read(self, index: int) -> Frame:
        """The source's frame, in the mirror. Raises what the source raises."""
        frame = self.source.read(index)
        return replace(
            frame,
            depth_m=np.ascontiguousarray(frame.depth_m[:, ::-1]),
            T_world_camera=MIRROR @ frame.T_world_camera @ MIRROR,
            camera=_mirrored(frame.camera),
        )


def _mirrored(camera: Camera) -> PinholeCamera:
    assert isinstance(camera, PinholeCamera)
    return replace(camera, cx=camera.width - 1 - camera.cx)


def points_of(frame: Frame, max_depth: float) -> NDArray[np.float64]:
    """Some thousands of a frame's points (N, 3) in the world."""
    depth_m = np.asarray(frame.depth_m, np.float64).ravel()
    seen = np.flatnonzero((depth_m > 0) & (depth_m < max_depth))
    seen = seen[:: max(1, len(seen) // 3000)]
    points = frame.camera.rays().reshape(-1, 3)[seen] * depth_m[seen, None]
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]


def run_located(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Where recordings are found, which are refused, and maps of two days beside those of one run."""
    (voxel_size,) = experiment.voxel_sizes
    tries = (
        *_same_places(experiment, voxel_size),
        *_whole_recordings(experiment, voxel_size),
        *_other_places(experiment, voxel_size),
    )
    columns = [
        "recording", "tries", *GRADES, "worst cm", "worst degrees", "sigma cm", "error^2 / sigma^2",
        "seconds", "at most", "MB",
    ]  # fmt: skip
    rows = [[name, *_entries(results)] for name, results in tries if results]
    note = (
        f"located: within {100 * RIGHT_M:g} cm and {RIGHT_DEGREES:g} degrees; wrong: beyond "
        f"{100 * WRONG_M:g} cm or {WRONG_DEGREES:g} degrees; near: between. error^2 / sigma^2: means of the "
        "squares of the place's error over its variance, and of the turn's. Seconds of all threads."
    )
    tables = [
        Table("located", "Recordings found in a map of another day", columns, rows, [note]),
        _merged(experiment, voxel_size),
    ]
    paths = [path for table in tables for path in write_table(experiment.out, table)]
    if experiment.limit is None:
        for table in tables:
            write_text(RESULTS / f"{table.name}.csv", as_csv(table))
    return tables, paths


Tries = Iterator[tuple[str, list[Result]]]


def _same_places(experiment: Experiment, voxel_size: float) -> Tries:
    """Tries in a map of every second frame, and of the first half."""
    for name, place, factor, most in HALVES:
        source, size = _source(experiment, place), factor * voxel_size
        dataset = open_dataset(source)
        count, half = len(dataset), len(dataset) // 2
        parts = {"second half": (range(half), range(half, count))}
        if name != "kitchen":
            parts["every second frame"] = (range(0, count, 2), range(1, count, 2))
        for part, (mapped, asked) in parts.items():
            yesterday, number = Yesterday(source, size, mapped), min(most, experiment.limit or most)
            here: list[Result] = []
            elsewhere: list[Result] = []
            for i, last in enumerate(
                np.linspace(RULES.whole_frames, len(asked), number).astype(int).tolist()
            ):
                first = last - RULES.whole_frames
                today = chosen(dataset, asked[first:last])
                key = f"{place} | {size:g} m | {part} | {first} | {i}"
                experiment.report(key, i, number)
                work = partial(yesterday.search, today, (experiment.seeds[0], i))
                result = experiment.ledger.result(key, work)
                shown = experiment.ledger.result(f"{key} | shown", partial(yesterday.shows, today))
                (here if shown["share"] > OVERLAP else elsewhere).append(result)
            yield f"{name}, {part}", here
            yield f"{name}, another part", elsewhere


def _whole_recordings(experiment: Experiment, voxel_size: float) -> Tries:
    """Second parts of recordings, and mirror images of them, from several frames on."""
    whole: list[Result] = []
    mirrored: list[Result] = []
    for name, place, factor, _ in HALVES:
        source, size = _source(experiment, place), factor * voxel_size
        dataset = open_dataset(source)
        count = len(dataset)
        parts = {"second half": range(count // 2), "every second frame": range(0, count, 2)}
        for part, mapped in parts.items():
            yesterday = Yesterday(source, size, mapped)
            rest = [index for index in range(count) if index not in mapped]
            for i, first in enumerate((0, len(rest) // 4, len(rest) // 2)[: experiment.limit]):
                today = chosen(dataset, rest[first:])
                key = f"{place} | {size:g} m | {part} | whole | {first}"
                work = partial(yesterday.search, today, (experiment.seeds[0], i))
                if name not in UNSEEN_HALVES or part == "every second frame":
                    whole.append(experiment.ledger.result(key, work))
                if isinstance(dataset.camera, PinholeCamera):
                    work = partial(yesterday.search, Mirrored.of(today), (experiment.seeds[0], i))
                    mirrored.append(experiment.ledger.result(f"{key} | mirrored", work))
    yield "whole second parts", whole
    yield "mirror images of these", mirrored


def _other_places(experiment: Experiment, voxel_size: float) -> Tries:
    """Recordings of other places: of each room in the maps of all others, and of the building by lidar in
    the maps of other lidars, and the other way around."""
    for name, places, size in (("room", ROOMS, voxel_size), ("place by lidar", LIDARS, 4 * voxel_size)):
        maps = {place: Yesterday(_source(experiment, each), size) for place, each in places.items()}
        results: list[Result] = []
        for number, (place, other) in enumerate(permutations(maps, 2)):
            both = {place, other}
            if both == COPIES or (place in LIDARS and "building" not in both):
                continue
            dataset, i = open_dataset(maps[other].source), list(maps).index(other)
            first = int(np.random.default_rng((number, i)).integers(max(1, len(dataset) // 2)))
            key = f"{place} | {other} | {size:g} m | {first}"
            experiment.report(key, number, len(maps) * (len(maps) - 1))
            today = chosen(dataset, range(first, len(dataset)))
            work = partial(maps[place].search, today, (experiment.seeds[0], i))
            results.append(experiment.ledger.result(key, work))
            if len(results) == experiment.limit:
                break
        yield f"another {name}", results


def _source(experiment: Experiment, place: str) -> str:
    return place if ":" in place else str(experiment.data / place)


GRADES = ("located", "near", "wrong", "refused")


def _grade(result: Result) -> str:
    if "off_m" not in result:
        return "refused"
    off_m, off_degrees = result["off_m"], result["off_degrees"]
    if off_m < RIGHT_M and off_degrees < RIGHT_DEGREES:
        return "located"
    return "wrong" if off_m > WRONG_M or off_degrees > WRONG_DEGREES else "near"


def _entries(results: Sequence[Result]) -> list[Entry]:
    """The columns of some tries."""
    grades = [_grade(result) for result in results]
    kept = [r for r, grade in zip(results, grades, strict=True) if grade in ("located", "near")]
    seconds = [result["seconds"] for result in results]
    figures = ["-"] * 4
    if kept:
        names = ("off_m", "off_degrees", "sigma_m", "sigma_degrees")
        off_m, off_degrees, sigma_m, sigma_degrees = np.array([[r[name] for name in names] for r in kept]).T
        squares = [np.mean((off_m / sigma_m) ** 2), np.mean((off_degrees / sigma_degrees) ** 2)]
        figures = [f"{x:.1f}" for x in (100 * off_m.max(), off_degrees.max(), 100 * sigma_m.mean())]
        figures.append("{:.2f}, {:.2f}".format(*squares))
    costs = [f"{np.mean(seconds):.1f}", f"{max(seconds):.1f}", f"{max(r['mb'] for r in results):.0f}"]
    return [len(results), *(grades.count(grade) for grade in GRADES), *figures, *costs]


def _merged(experiment: Experiment, voxel_size: float) -> Table:
    """The kitchen mapped in one run, and its second half onto a map of the first."""
    source = _source(experiment, KITCHEN)
    dataset = open_dataset(source)
    count, every = len(dataset), Config().evaluation.hold_out
    judged = [i for i in range(count) if is_held_out(i + 1, every)]
    mapped = [i for i in range(count) if i not in judged]
    rows: list[list[Entry]] = []
    for name, last in (("one run", count), ("second half onto the first", count // 2)):
        m = Yesterday(source, voxel_size, [i for i in mapped if i < last]).map
        frames = [dataset.read(i) for i in judged if i < last]
        if last < count:
            today = chosen(dataset, range(last, count))
            placed = placed_in(m, "the first half", moved_away(today, (0,)))
            frames += [placed.read(i - last) for i in judged if i >= last]
            for i in mapped:
                if i >= last:
                    m.add(placed.read(i - last))
        m.infer()
        error = pooled_depth_error(
            (m.render_depth(f.camera, f.T_world_camera), surface_depth(f, m.noise)) for f in frames
        )
        figures = f"{1000 * error.median_abs:.2f}", f"{1000 * error.rms:.1f}", f"{100 * error.unanswered:.2f}"
        rows.append([name, len(m.keyframes), len(frames), *figures])
    columns = ["kitchen", "keyframes", "held-out frames", "median error mm", "RMS mm", "unanswered %"]
    return Table("located_maps", "A map of two days beside that of one run", columns, rows)
