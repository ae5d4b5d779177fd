"""A map of a room that changes: how soon it shows what has come and forgets what has left, and what a robot
that trusts it would hit.

The room follows one of three scripts (`synthetic:room?moving=...`). The map takes a keyframe a second, as a
live run does, and after each of them it is compared with the true scene at that time.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.lab.moving_truth import NEAR_M, Mask, MovingTruth, Points, Standing, voxel_keys
from benchmarks.lab.robot_paths import RADIUS_M, Drives, Paths
from taichi_mrf import Frame, LogOddsMap, MRFMap, PolynomialNoise, open_dataset
from taichi_mrf.config.sections import LIVE_HALF_LIFE_S, TimeConfig
from taichi_mrf.datasets.synthetic.room import SyntheticRoom, distance_to_solids
from taichi_mrf.datasets.synthetic.room_furniture import ROOM_IN_WORLD
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.methods.capabilities import has_messages
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.simulate import KINECT_1

FRAMES = 60
SIZE = "&width=160&height=120"
DATED = TimeConfig(half_life_s=LIVE_HALF_LIFE_S)

WATCHED_S = 15.0
"""For so long after something has come or left a map may take to show it."""

SHOWN, GONE = 0.5, 0.05
"""A newcomer is there when the map shows this share of the voxels that the views of it alone would show; a
ghost is gone when no more than this share of its voxels is left."""

LEAST_VOXELS = 10
"""Views that alone would show fewer voxels of a thing decide nothing."""

FRESH_S = 10.0
"""Seconds for which a thing that came to its place is new."""

POINTS = 300
"""At most so many points of new things are looked at in each view."""

ON_M = 1e-3
"""A true point this near to a surface lies on it."""

PATHS = 40
"""After each keyframe."""

FIRST_DRIVE = 10
"""Keyframes that a robot waits for."""

PATH_LOWER, PATH_UPPER = (-2.8, -2.3, 0.25), (2.8, 2.3, 1.5)
"""Corners of the box that paths stay in, in the room's own frame."""

PATH_REACH_M = 1.4
"""Along x and y, paths stay this near to what the camera looks at."""


@dataclass(frozen=True)
class ChangeContender:
    """A method with fixed parameters. ``make`` gives an empty map of a voxel size; ``layered`` maps have a
    dynamic layer."""

    name: str
    parameters: str
    make: Callable[[float], OccupancyMap]
    layered: bool = False


def static_mrf() -> ChangeContender:
    """MRFMap as for a static world."""
    return ChangeContender("MRFMap, static", "defaults", lambda size: MRFMap(size, _noise()))


def dated_mrf(time: TimeConfig = DATED) -> ChangeContender:
    """MRFMap with dated evidence."""
    parameters = f"half-life {time.half_life_s:g} s, moving share {time.moving_share:g}"
    return ChangeContender(
        "MRFMap, dated", parameters, lambda size: MRFMap(size, _noise(), time=time), layered=True
    )


def clamped_log_odds(name: str, hit: float, miss: float, half_life_s: float = 0.0) -> ChangeContender:
    """Log-odds with OctoMap's clamping, and with decay if there is a half-life."""
    decay = f", half-life {half_life_s:g} s" if half_life_s else ""
    time = TimeConfig(half_life_s=half_life_s)
    return ChangeContender(
        name,
        f"hit {hit:g}, miss {miss:g}{decay}",
        lambda size: LogOddsMap(size, _noise(), time=time, hit=hit, miss=miss),
    )


def _noise() -> PolynomialNoise:
    return PolynomialNoise(KINECT_1.sigma, KINECT_1.bias)


def moving_truth(script: str, seed: int, frames: int) -> MovingTruth:
    """The truth about one script of the room; its frames are those of ``truth.room``."""
    room = open_dataset(f"synthetic:room?moving={script}&frames={frames}&seed={seed}{SIZE}", color=False)
    assert isinstance(room, SyntheticRoom)
    return MovingTruth(room)


@dataclass
class Watch:
    """How many views it takes until a map shows that a thing has come, or that it has left. ``seen`` counts
    the views that see it, ``after`` is how many of them it took, None if they did not suffice."""

    name: str
    seen: int = 0
    after: int | None = None

    def see(self, done: bool) -> None:
        """One more view that sees it; ``done`` if the map is now right."""
        if self.after is None:
            self.seen += 1
            self.after = self.seen if done else None


@dataclass
class _Place:
    """A standing thing's coming and leaving, as a map shows them."""

    standing: Standing
    came: Watch | None
    left: Watch | None
    alone: OccupancyMap
    before: int = 0

    @staticmethod
    def of(standing: Standing, last_s: float, alone: OccupancyMap) -> "_Place":
        came = Watch(standing.name) if standing.start_s > 0 else None
        left = Watch(standing.name) if standing.end_s <= last_s else None
        return _Place(standing, came, left, alone)

    def follow(self, truth: MovingTruth, index: int, frame: Frame, occupied: Points) -> None:
        """Count what the map shows of the place after a frame."""
        t, standing = frame.stamp, self.standing
        present = standing.start_s <= t < standing.end_s
        coming = self.came is not None and present and t < standing.start_s + WATCHED_S
        leaving = self.left is not None and standing.end_s <= t < standing.end_s + WATCHED_S
        if not (coming or leaving or present):
            return
        shown = int(truth.belong(standing, occupied, t).sum())
        if present:
            self.before = shown
        if coming and self.came is not None and self.came.after is None:
            add(self.alone, frame)
            if truth.sees(standing, index):
                could = int(truth.belong(standing, self.alone.marginals.voxels()[0], t).sum())
                self.came.see(could >= LEAST_VOXELS and shown >= SHOWN * could)
        if leaving and self.left is not None and self.before >= LEAST_VOXELS and truth.sees(standing, index):
            self.left.see(shown <= GONE * self.before)


def add(m: OccupancyMap, frame: Frame) -> None:
    """Add a frame, and bring the map up to date as a live run does."""
    id = m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name, stamp_s=frame.stamp)
    if has_messages(m):
        m.renew([id])


@dataclass
class _New:
    """Sums over the frames: ``points`` of things that came to their place not long ago, as the views show
    them, how many of them have an occupied voxel of the map near by, and how many one of its dynamic layer;
    the ``voxels`` of that layer, and how many of these are near something that was not there at the start."""

    points: int = 0
    in_map: int = 0
    in_layer: int = 0
    voxels: int = 0
    right: int = 0

    def follow(self, truth: MovingTruth, index: int, occupied: Points, layer: Points) -> None:
        """Count a frame: all occupied voxels, (n, 3), and those of the layer."""
        t = truth.room.stamp_at(index)
        fresh = truth.newly_there(t, FRESH_S)
        points = truth.surface_points(index)
        points = points[distance_to_solids(fresh, points) < ON_M]
        points = points[:: 1 + len(points) // POINTS]
        self.points += len(points)
        self.in_map += _near_by(points, occupied[distance_to_solids(fresh, occupied) < 2 * NEAR_M])
        self.in_layer += _near_by(points, layer)
        self.voxels += len(layer)
        self.right += int((distance_to_solids(truth.newly_there(t), layer) <= NEAR_M).sum())


def _near_by(points: Points, voxels: Points) -> int:
    """How many points (N, 3) have a voxel (n, 3) within NEAR_M along each axis."""
    near = np.ones((len(points), len(voxels)), np.bool_)
    for axis in range(3):
        near &= np.abs(points[:, None, axis] - voxels[None, :, axis]) <= NEAR_M
    return int(near.any(axis=1).sum())


def run_script(
    contender: ChangeContender, truth: MovingTruth, voxel_size: float, tuning: bool = False
) -> Result:
    """One map of one script, followed from keyframe to keyframe. Plain values, for the ledger.
    ``tuning`` leaves out the robot, and the comparison with a map without moving things."""
    m, bare = contender.make(voxel_size), contender.make(voxel_size)
    room, drives, new = truth.room, Drives(), _New()
    last_s = room.stamp_at(len(room) - 1)
    places = [_Place.of(each, last_s, contender.make(voxel_size)) for each in truth.standings]
    swept, trail = truth.swept(voxel_size), []
    occupied = np.zeros((0, 3))
    for index in range(len(room)):
        frame = room.read(index)
        add(m, frame)
        if not tuning:
            add(bare, truth.frame_without_things(index))
        occupied = m.marginals.voxels()[0]
        for place in places:
            place.follow(truth, index, frame, occupied)
        if len(swept):
            left = occupied[swept.has(occupied)]
            trail.append(int(truth.away_from_things(left, frame.stamp).sum()) / len(swept))
        layer = m.dynamic.voxels()[0] if contender.layered else occupied[:0]  # type: ignore[attr-defined]
        new.follow(truth, index, occupied, layer)
        if not tuning and index >= FIRST_DRIVE:
            paths, clearance_m = _paths(truth, index)
            drives.add(paths.trusted(m), clearance_m)
    came, left_ = ([asdict(w) for w in each if w is not None and w.seen] for each in (
        [p.came for p in places], [p.left for p in places],
    ))  # fmt: skip
    return {
        "came": came,
        "left": left_,
        "trail": trail,
        "new": asdict(new),
        "drives": asdict(drives),
        **_walls(truth, occupied, bare.marginals.voxels()[0], voxel_size),
    }


def perfect_drives(truth: MovingTruth) -> Drives:
    """Outcome of the same paths if they are planned on the true scene at each keyframe's time."""
    drives = Drives()
    for index in range(FIRST_DRIVE, len(truth.room)):
        paths, clearance_m = _paths(truth, index)
        seen_m = paths.clearance(truth.scene.at(truth.room.stamp_at(index)))
        drives.add(seen_m > RADIUS_M, clearance_m)
    return drives


def _paths(truth: MovingTruth, index: int) -> tuple[Paths, NDArray[np.float64]]:
    """Random paths after a keyframe, and how near they come to surfaces at a random time before the next one,
    (PATHS,) metres."""
    seed = (truth.room.options.seed, index)
    target = np.array(truth.scene.camera.target)
    reach = np.array([PATH_REACH_M, PATH_REACH_M, np.inf])
    lower = np.maximum(target - reach, np.add(PATH_LOWER, ROOM_IN_WORLD))
    upper = np.minimum(target + reach, np.add(PATH_UPPER, ROOM_IN_WORLD))
    paths = Paths.random(PATHS, lower, upper, seed)
    stamp_s = truth.room.stamp_at(index) + float(np.random.default_rng(seed).random())
    return paths, paths.clearance(truth.scene.at(stamp_s))


def _walls(truth: MovingTruth, occupied: Points, bare: Points, voxel_size: float) -> dict[str, Any]:
    """At the end: the voxels of walls and furniture that a map without moving things shows, how many of them
    this map has no occupied voxel in or beside, the same share of true points of walls and furniture, and the
    shares of occupied voxels that no surface passes through, and that are far from any."""
    walls = bare[truth.walls(bare, voxel_size)]
    points = np.concatenate([truth.surface_points(i)[::9] for i in range(0, len(truth.room), 5)])
    points = points[np.abs(truth.scene.static.signed_distance(points)) < ON_M]
    scene = truth.scene.at(truth.room.stamp_at(len(truth.room) - 1))
    distance_m = scene.signed_distance(occupied)
    return {
        "walls": len(walls),
        "walls_lost": int((~_beside(walls, occupied, voxel_size)).sum()),
        "points_lost": float((~_beside(points, occupied, voxel_size)).mean()),
        "no_surface": float((np.abs(distance_m) > 0.87 * voxel_size).mean()),
        "in_the_air": float((distance_m > 2 * NEAR_M).mean()),
    }


def _beside(points: Points, occupied: Points, voxel_size: float) -> Mask:
    """Which points (N, 3) lie in an occupied voxel or in one of the 26 around it, (N,)."""
    keys = voxel_keys(occupied, voxel_size)
    beside = np.zeros(len(points), np.bool_)
    for step in np.indices((3, 3, 3)).reshape(3, -1).T - 1:
        beside |= np.isin(voxel_keys(points + step * voxel_size, voxel_size), keys)
    return beside
