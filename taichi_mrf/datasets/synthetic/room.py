"""``synthetic:room``: a furnished room that needs no download, with ground truth and a simulated sensor.

Options follow a question mark, ``synthetic:room?frames=60&width=640&height=480&noise=none&seed=1``; the
fields of :class:`RoomOptions` are the options. ``synthetic:room?moving=walker&frames=60`` is a room in which
something happens, with a frame a second: things come, go and are moved, a door opens and closes, or a person
walks. A thing is a rigid group of solids that stands or moves on straight ways, and is absent in between. A
``variant`` (any number) turns the same script into another scene: other places, other times, another start of
the camera. Places of a script are in the room's own frame, as in room_furniture.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.datasets.synthetic.analytic_scene import Point, Scene, Solid, translated
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions, open_scene
from taichi_mrf.datasets.synthetic.room_furniture import (
    CLOTH,
    DARK_WOOD,
    HEIGHT,
    LENGTH,
    METAL,
    NEAR_WALL,
    PLASTER,
    ROOM_IN_WORLD,
    WALL,
    WHITE,
    WIDTH,
    WOOD,
    box,
    camera_pose,
    chair,
    cylinder,
    room_scene,
    room_solids,
    sphere,
)
from taichi_mrf.geometry.poses import Pose, look_at

STANDS_S = 5.0
"""A thing that stays in one place for this long stands there; a shorter stop is part of its way."""


@dataclass(frozen=True)
class Place:
    """Place of a thing: its own origin in the world, and its yaw about the vertical (radians)."""

    x: float
    y: float
    z: float = 0.0
    yaw: float = 0.0

    def towards(self, other: "Place", share: float) -> "Place":
        """The place at ``share``, 0 to 1, of the straight way to another."""
        return Place(*(a + share * (b - a) for a, b in zip(astuple(self), astuple(other), strict=True)))


@dataclass(frozen=True)
class Stay:
    """A thing's presence from ``start_s`` to before ``end_s``, on the straight way between two places."""

    start_s: float
    end_s: float
    begin: Place
    end: Place

    @property
    def stands(self) -> bool:
        """True if the thing stands in one place, and for long enough to count as standing."""
        return self.begin == self.end and self.end_s - self.start_s >= STANDS_S

    def place(self, stamp_s: float) -> Place:
        """Place of the thing at a time of the stay."""
        return self.begin.towards(self.end, (stamp_s - self.start_s) / (self.end_s - self.start_s))


@dataclass(frozen=True)
class Thing:
    """Solids in the thing's own frame, and its stays in the order of time. It is absent between them."""

    name: str
    solids: tuple[Solid, ...]
    stays: tuple[Stay, ...]

    @property
    def walks(self) -> bool:
        """True if the thing never stands."""
        return not any(stay.stands for stay in self.stays)

    def solids_at(self, stamp_s: float) -> tuple[Solid, ...]:
        """The solids in the world at a time; none while the thing is absent."""
        for stay in self.stays:
            if stay.start_s <= stamp_s < stay.end_s:
                return placed(self.solids, stay.place(stamp_s))
        return ()

    def moved_by(self, offset: Point) -> "Thing":
        """Copy of the thing with all its places moved."""
        x, y, z = offset

        def moved(place: Place) -> Place:
            return Place(place.x + x, place.y + y, place.z + z, place.yaw)

        stays = tuple(replace(s, begin=moved(s.begin), end=moved(s.end)) for s in self.stays)
        return replace(self, stays=stays)


@dataclass(frozen=True)
class Sway:
    """A camera that swings to and fro on an arc around what it looks at, from ``first`` to ``last`` (radians
    about the vertical), and up and down a little."""

    target: Point
    radius_m: float
    height_m: float
    """Of the arc over the target, in the middle."""

    first: float
    last: float
    period_s: float = 23.0
    phase: float = 0.0

    def pose(self, stamp_s: float) -> Pose:
        """T_world_camera at a time, (4, 4)."""
        turn = 2 * math.pi * (stamp_s / self.period_s + self.phase)
        angle = self.first + (self.last - self.first) * (0.5 - 0.5 * math.cos(turn))
        lift = self.height_m + 0.15 * math.sin(0.7 * turn)
        x, y, z = self.target
        eye = (x + self.radius_m * math.cos(angle), y + self.radius_m * math.sin(angle), z + lift)
        return look_at(eye, self.target)


@dataclass(frozen=True)
class MovingScene:
    """A scene of what never moves, and things that come, go and move. It repeats itself every ``period_s``
    seconds; ``camera`` is the path of a camera that sees it happen."""

    static: Scene
    things: tuple[Thing, ...]
    period_s: float
    camera: Sway

    def at(self, stamp_s: float) -> Scene:
        """All solids at a time."""
        return replace(self.static, solids=(*self.static.solids, *self.solids_of_things(stamp_s)))

    def solids_of_things(self, stamp_s: float) -> tuple[Solid, ...]:
        """The solids at a time of all that moves at any time."""
        within = stamp_s % self.period_s
        return tuple(solid for thing in self.things for solid in thing.solids_at(within))


def placed(solids: Iterable[Solid], place: Place) -> tuple[Solid, ...]:
    """Copy of the solids, turned about the vertical through the origin and moved to a place."""
    c, s = math.cos(place.yaw), math.sin(place.yaw)
    moved = []
    for solid in solids:
        x, y, z = solid.center
        center = (place.x + c * x - s * y, place.y + s * x + c * y, place.z + z)
        moved.append(replace(solid, center=center, yaw=solid.yaw + place.yaw))
    return tuple(moved)


def distance_to_solids(solids: Sequence[Solid], points: ArrayLike) -> NDArray[np.float64]:
    """Signed distance, (N,), of points (N, 3) to some solids; infinite if there are none."""
    return Scene(tuple(solids), (0.0, 0.0, 0.0)).signed_distance(points)


def way(start_s: float, speed: float, corners: Sequence[tuple[float, float]]) -> tuple[Stay, ...]:
    """The stays of something that walks along a line of corners (x, y) on the floor at a speed in metres per
    second. It faces where it goes, and turns on the spot in no time."""
    stays = []
    for (x, y), (to_x, to_y) in pairwise(corners):
        end_s = start_s + math.hypot(to_x - x, to_y - y) / speed
        yaw = math.atan2(to_y - y, to_x - x)
        stays.append(Stay(start_s, end_s, Place(x, y, 0.0, yaw), Place(to_x, to_y, 0.0, yaw)))
        start_s = end_s
    return tuple(stays)


PERIOD_S = 60.0
"""All scripts take a minute."""

SPOTS = ((0.6, -0.95), (1.55, -1.35), (-0.3, -1.45), (2.2, -0.55), (1.1, -1.75), (0.1, -0.6))
"""Places (x, y) on the free floor."""

DOOR_X, DOOR_Y, DOOR_WIDTH, DOOR_HEIGHT = 1.74, -2.47, 0.92, 2.05
"""The hinge of the door, and the size of its leaf and of the doorway."""

OPEN = math.radians(105)
BEYOND_M = 1.6
"""Depth of the small room behind the doorway."""

WALK_M_S = 0.8
SKIN = (0.80, 0.60, 0.48)


def moving_room(script: str, variant: int = 0) -> MovingScene:
    """One of SCRIPTS in the world frame."""
    scene = SCRIPTS[script](variant)
    x, y, z = ROOM_IN_WORLD
    target = scene.camera.target
    return MovingScene(
        Scene(translated(scene.static.solids, ROOM_IN_WORLD), light=(x - 0.2, y - 0.3, z + 2.5)),
        tuple(thing.moved_by(ROOM_IN_WORLD) for thing in scene.things),
        scene.period_s,
        replace(scene.camera, target=(target[0] + x, target[1] + y, target[2] + z)),
    )


def _things(variant: int) -> MovingScene:
    """A ball and a stool that appear, a crate that leaves, a chair that is moved."""
    turned = variant % len(SPOTS)
    spots = [Place(*spot, yaw=0.4 * variant) for spot in (*SPOTS[turned:], *SPOTS[:turned])]
    late = float(variant % 4)

    def stays(spot: int, start_s: float, end_s: float) -> Stay:
        start, end = (t + late if 0 < t < PERIOD_S else t for t in (start_s, end_s))
        return Stay(start, end, spots[spot], spots[spot])

    ball = Thing("ball", (sphere(0, 0, 0.3, 0.25, (0.2, 0.5, 0.8)),), (stays(0, 20, 42),))
    crate = Thing("crate", (box(0, 0, 0, (0.45, 0.35, 0.5), WOOD),), (stays(1, 0, 24),))
    moved = Thing("chair", tuple(chair(0, 0, 0.0)), (stays(2, 0, 28), stays(3, 28, PERIOD_S)))
    stool = Thing("stool", (cylinder(0, 0, 0, 0.2, 0.6, CLOTH),), (stays(4, 32, PERIOD_S),))
    return MovingScene(_lit(room_solids()), (ball, crate, moved, stool), PERIOD_S, _at_the_floor(variant))


def _door(variant: int) -> MovingScene:
    """The door opens, stands open for a while, and closes; behind it is a small room."""
    opens, closes = 18.0 + variant % 4, 40.0 - variant % 3
    shut, wide = (Place(DOOR_X, DOOR_Y, 0.0, yaw) for yaw in (0.0, OPEN))
    stays = (
        Stay(0.0, opens, shut, shut),
        Stay(opens, opens + 2, shut, wide),
        Stay(opens + 2, closes, wide, wide),
        Stay(closes, closes + 2, wide, shut),
        Stay(closes + 2, PERIOD_S, shut, shut),
    )
    first, last = math.radians(78), math.radians(118)
    arc = Sway((1.8, -2.0, 0.9), 2.4, 0.6, first, last, phase=0.37 * variant)
    return MovingScene(_lit(room_solids(_doorway())), (Thing("door", _leaf(), stays),), PERIOD_S, arc)


def _walker(variant: int) -> MovingScene:
    """A person comes in through the open door, walks about, and leaves; twice."""
    entry = [(1.0, -3.5), (2.1, -3.4), (2.08, -2.5), (1.98, -1.5)]
    ways = ([(1.25, -1.0), (0.1, -1.4), (0.9, -0.7)], [(1.9, -0.7), (0.6, -0.6), (0.3, -1.5), (1.2, -0.9)])
    passes: list[Stay] = []
    for number, start_s in enumerate((16.0, 38.0)):
        corners = ways[(number + variant) % 2]
        if variant // 2 % 2:
            corners = corners[::-1]
        passes += way(start_s + variant % 3, WALK_M_S, [*entry, *corners, *entry[::-1]])
    open_door = placed(_leaf(), Place(DOOR_X, DOOR_Y, 0.0, OPEN))
    static = _lit([*room_solids(_doorway()), *open_door])
    return MovingScene(static, (Thing("person", _person(), tuple(passes)),), PERIOD_S, _at_the_floor(variant))


def _lit(solids: Sequence[Solid]) -> Scene:
    return Scene(tuple(solids), light=(-0.2, -0.3, 2.5))


def _at_the_floor(variant: int) -> Sway:
    """A camera that looks at the free floor, over the low furniture."""
    first, last = math.radians(95), math.radians(185)
    return Sway((0.8, -1.0, 0.75), 2.5, 0.75, first, last, phase=0.37 * variant)


def _leaf() -> tuple[Solid, ...]:
    """The door's leaf; its hinge is at the origin, and shut it lies along x."""
    middle = DOOR_WIDTH / 2
    leaf = box(middle, 0, 0, (DOOR_WIDTH, 0.06, DOOR_HEIGHT), DARK_WOOD)
    return (leaf, sphere(DOOR_WIDTH - 0.11, 0.07, 1.05, 0.035, METAL))


def _doorway() -> list[Solid]:
    """The wall at the lowest y with an opening as large as the door, and a small room behind it."""
    y, left, right = -(WIDTH + WALL) / 2, -LENGTH / 2 - WALL, LENGTH / 2 + WALL
    beyond = DOOR_X + DOOR_WIDTH
    low, back = 0.5, y - WALL / 2 - BEYOND_M
    span, middle = right - low, (low + right) / 2
    depth, y_middle = BEYOND_M + WALL, y - WALL / 2 - BEYOND_M / 2
    return [
        box((left + DOOR_X) / 2, y, 0, (DOOR_X - left, WALL, HEIGHT), NEAR_WALL),
        box((beyond + right) / 2, y, 0, (right - beyond, WALL, HEIGHT), NEAR_WALL),
        box((DOOR_X + beyond) / 2, y, DOOR_HEIGHT, (DOOR_WIDTH, WALL, HEIGHT - DOOR_HEIGHT), NEAR_WALL),
        box(middle, y_middle, -WALL, (span, depth, WALL), WOOD),
        box(middle, y_middle, HEIGHT, (span, depth, WALL), WHITE),
        box(middle, back - WALL / 2, 0, (span, WALL, HEIGHT), PLASTER),
        box(low - WALL / 2, y_middle, 0, (WALL, depth, HEIGHT), PLASTER),
        box(right - WALL / 2, y_middle, 0, (WALL, depth, HEIGHT), PLASTER),
    ]


def _person() -> tuple[Solid, ...]:
    """A person of 1.75 m who faces along x."""
    return (
        cylinder(0.12, 0.10, 0, 0.075, 0.85, DARK_WOOD),
        cylinder(-0.12, -0.10, 0, 0.075, 0.85, DARK_WOOD),
        cylinder(0, 0, 0.80, 0.18, 0.62, CLOTH),
        cylinder(0, 0.24, 0.78, 0.05, 0.60, CLOTH),
        cylinder(0, -0.24, 0.78, 0.05, 0.60, CLOTH),
        cylinder(0, 0, 1.40, 0.06, 0.12, SKIN),
        sphere(0, 0, 1.62, 0.13, SKIN),
    )


SCRIPTS: dict[str, Callable[[int], MovingScene]] = {"things": _things, "door": _door, "walker": _walker}
"""The scripts by name, in the room's own frame; each takes a variant."""

NAME = "synthetic:room"


@dataclass(frozen=True)
class RoomOptions(RenderOptions):
    """The options of the built-in room. At 32 frames the camera takes 6.4 s for its round."""

    moving: Literal["none", "things", "door", "walker"] = "none"
    """Moving things: none; things that appear, leave and are moved; a door; or a person who walks through. If
    something moves, the seed chooses places and times too, a frame is taken every second, and the camera
    looks at what happens."""


@dataclass
class SyntheticRoom(RenderedSequence):
    """The synthetic room as a sequence of frames; the camera's path through it is closed."""

    options: RoomOptions = RoomOptions()

    @cached_property
    def moving_scene(self) -> MovingScene | None:
        """Events in the room, in the world frame; None if nothing moves."""
        if self.options.moving == "none":
            return None
        return moving_room(self.options.moving, self.options.seed)

    @cached_property
    def scene(self) -> Scene:
        """The solids in the room that never move, in the world frame."""
        return self.moving_scene.static if self.moving_scene else room_scene()

    def scene_at(self, index: int) -> Scene:
        return self.moving_scene.at(self.stamp_at(index)) if self.moving_scene else self.scene

    def stamp_at(self, index: int) -> float:
        return float(index) if self.moving_scene else super().stamp_at(index)

    def pose_at(self, index: int) -> Pose:
        if self.moving_scene:
            return self.moving_scene.camera.pose(self.stamp_at(index))
        return camera_pose(index / self.options.frames)


open_synthetic_room = partial(open_scene, SyntheticRoom, NAME)
