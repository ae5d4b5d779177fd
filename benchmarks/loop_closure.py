"""Cost of a closed loop: most poses of a trajectory change, and the map follows.

    python -m benchmarks.loop_closure --keyframes 500 --moved 300 --voxel-size 0.05

A camera walks once around the built-in ring corridor (63 m). The last poses are off by 1 to 30 cm, until
the loop is closed and ``update_poses`` takes in the true ones. The rows compare the map after so many seconds
with the map made anew: the share of its voxels whose probability is within 0.02, the share whose answer
(occupied: above 0.5) is the same, and the accuracy (1.5 sigma) of views held out of the part that moves, each
halfway between two keyframes. A map is usable when that accuracy is within two points of the new one and 98%
of the answers are the same; "within a point" says when it is within one.

Beside it, OctoMap and Open3D's TSDF are rebuilt from all frames, if they are installed (extra ``bench``).
"""

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.lab.surface import Open3DGrid
from taichi_mrf import Frame, MRFMap, accuracy, open_dataset
from taichi_mrf.config.schema import Arch, VolumeConfig
from taichi_mrf.errors import TaichiMRFError
from taichi_mrf.evaluation.bench import octomap_available, octomap_inserter
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system import runtime

HELD_OUT = 20
DRIFT_M, DRIFT_RADIANS = (0.22, 0.20, 0.04), math.radians(1.0)
"""Error of the last pose: 30 cm, and a degree about the vertical."""

POINT, SAME_ANSWERS = 0.01, 0.98
USABLE_POINTS = 2
TRUNCATION = 4.0
"""Of Open3D's distances, in voxels."""


@dataclass(frozen=True)
class Options:
    """Recording to map, and the way to look at it."""

    keyframes: int = 500
    """Keyframes of the walk."""

    moved: int = 300
    """How many of them move when the loop closes, the last ones."""

    width: int = 160
    """Columns of the depth images."""

    height: int = 120
    """Rows of the depth images."""

    voxel_size: float = 0.05
    """Metres."""

    step_s: float = 0.25
    """Seconds of update_poses from one row to the next."""

    rivals: bool = True
    """Rebuild OctoMap and Open3D's TSDF too."""

    arch: Arch = "auto"
    """Backend."""


class Walk:
    """Keyframes of a walk around the ring corridor, of which the last ``moved`` have drifted. Every second
    frame of the walk is a keyframe."""

    def __init__(self, keyframes: int, moved: int, width: int = 160, height: int = 120) -> None:
        name = f"synthetic:ring?frames={2 * keyframes}&width={width}&height={height}"
        self._ring = open_dataset(name, color=False)
        self.moved, self.stay = moved, keyframes - moved
        self.keyframes = [self._ring.read(2 * number) for number in range(keyframes)]
        self.true = {number: frame.T_world_camera for number, frame in enumerate(self.keyframes)}

    @property
    def drifted(self) -> dict[int, Pose]:
        """Their poses before the loop is closed: off by 1 cm for the first of those that move, 30 cm for the
        last."""
        return {number: self._drifted(number) for number in self.true}

    def held_out(self) -> list[Frame]:
        """Views between keyframes, evenly spread over those that move."""
        numbers = self.stay + np.floor((np.arange(HELD_OUT) + 0.5) * self.moved / HELD_OUT).astype(int)
        return [self._ring.read(2 * number + 1) for number in sorted(set(numbers.tolist()))]

    def _drifted(self, number: int) -> Pose:
        T = self.true[number].copy()
        if number < self.stay:
            return T
        share = 1 / 30 + 29 / 30 * (number - self.stay) / max(1, self.moved - 1)
        c, s = math.cos(share * DRIFT_RADIANS), math.sin(share * DRIFT_RADIANS)
        T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ T[:3, :3]
        T[:3, 3] += share * np.array(DRIFT_M)
        return T


class Clock:
    """Wall-clock and CPU seconds of the blocks that it watches."""

    def __init__(self) -> None:
        self.wall = self.cpu = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count the seconds of the block."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu


class Judge:
    """Compares a map with the map made anew."""

    def __init__(self, anew: MRFMap, held_out: Sequence[Frame]) -> None:
        self.anew, self.held_out = anew, held_out
        self.centres, self.p = anew.marginals.voxels(0.0)
        self.accuracy = self._accuracy(anew)

    def row(self, what: str, m: MRFMap, clock: Clock) -> float:
        """Print a row and return how many points the map is less accurate than the new one; infinite if too
        many answers differ."""
        p = m.marginals.occupancy(self.centres)
        near = float((np.abs(p - self.p) <= 0.02).mean())
        same = float(((p > 0.5) == (self.p > 0.5)).mean())
        right = self._accuracy(m)
        seconds = f"{clock.wall:7.2f}  {clock.cpu:9.2f}"
        print(f"{what:34s}  {seconds}  {near:6.4f}  {same:6.4f}  {right:8.4f}", flush=True)
        return (self.accuracy - right) / POINT if same >= SAME_ANSWERS else math.inf

    def equal(self, m: MRFMap) -> bool:
        """True if the maps have the same voxels with the same probabilities, bit for bit."""
        (centres, p), (others, q) = (_sorted(*each.marginals.voxels(0.0)) for each in (m, self.anew))
        return np.array_equal(centres, others) and np.array_equal(p, q)

    def _accuracy(self, m: MRFMap) -> float:
        views = ((f.depth_m, f.T_world_camera, f.camera) for f in self.held_out)
        return float(np.mean([accuracy(m, *view, tolerance="1.5sigma").score for view in views]))


def main() -> None:
    """Print the rows, and what the others take."""
    options = tyro.cli(Options, description=__doc__)
    runtime.init(options.arch)
    walk = Walk(options.keyframes, options.moved, options.width, options.height)
    making = Clock()
    with making.running():
        anew = built(walk.keyframes, walk.true, options.voxel_size)
    judge = Judge(anew, walk.held_out())
    m = built(walk.keyframes, walk.drifted, options.voxel_size)
    warm_up(walk.keyframes, options.voxel_size)

    print("map                                 seconds  processors    near    same  accuracy")
    clock = Clock()
    judge.row("before", m, clock)
    after_s: dict[int, float] = {}
    for left in closed(m, walk.true, options.step_s, clock):
        what = f"{options.moved - left} of {options.moved} moved" if left else "others swept again"
        behind = judge.row(what, m, clock)
        for points in (USABLE_POINTS, 1):
            if behind <= points:
                after_s.setdefault(points, clock.wall)
    with clock.running():
        m.infer()
    judge.row("inferred", m, clock)
    print(f"bit for bit the map made anew: {judge.equal(m)}")
    for points, seconds in after_s.items():
        print(f"{'usable' if points == USABLE_POINTS else 'within a point'} after {seconds:.2f} s")
    judge.row("the map made anew", anew, making)
    if options.rivals:
        for name, seconds in rebuilt_by_others(walk.keyframes, options.voxel_size).items():
            print(f"{name} from all frames: {seconds:.1f} s")


def closed(m: MRFMap, poses: dict[int, Pose], step_s: float, clock: Clock) -> Iterator[int]:
    """Take in the poses in steps of so many seconds, which the clock counts; yields after each how many are
    left."""
    left, complete = poses, False
    while not complete:
        with clock.running():
            update = m.update_poses(left, least=0.0, seconds=step_s)
        left, complete = dict(update.left), update.complete
        yield len(left)


def built(frames: Sequence[Frame], poses: dict[int, Pose], voxel_size: float) -> MRFMap:
    """The inferred map of frames at other poses."""
    m = MRFMap(voxel_size)
    for number, frame in enumerate(frames):
        m.add_keyframe(frame.depth_m, poses[number], frame.camera, frame.name)
    m.infer()
    return m


def warm_up(frames: Sequence[Frame], voxel_size: float) -> None:
    """Compile what is measured."""
    m = built(frames[:2], {i: frame.T_world_camera for i, frame in enumerate(frames[:2])}, voxel_size)
    T = frames[0].T_world_camera.copy()
    T[0, 3] += 2 * voxel_size
    m.update_poses({0: T, 1: T})


def rebuilt_by_others(frames: Sequence[Frame], voxel_size: float) -> dict[str, float]:
    """Seconds in which OctoMap and Open3D make their maps of all frames, for those that are installed."""
    seconds = {}
    if octomap_available():
        insert = octomap_inserter(voxel_size)
        seconds["OctoMap"] = sum(insert(frame).wall for frame in frames)
    try:
        scene = Scene("loop", frames[0].camera, MRFMap(voxel_size).noise, VolumeConfig(), 10.0, ())
        grid = Open3DGrid(scene, voxel_size, TRUNCATION, len(frames))
        seconds["Open3D's TSDF"] = grid.fuse([(frame.depth_m, frame.T_world_camera) for frame in frames])
    except TaichiMRFError as missing:
        print(f"without Open3D: {missing}")
    return seconds


def _sorted(
    centres: NDArray[np.float64], p: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    order = np.lexsort(centres.T)
    return centres[order], p[order]


if __name__ == "__main__":
    main()
