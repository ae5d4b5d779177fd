"""Built-in walks with ground truth: ``synthetic:corridor``, through a corridor and the furnished rooms off
it, and ``synthetic:ring``, once around a corridor that leads back to its beginning.

Options follow a question mark, ``synthetic:corridor?rooms=4&frames=200&width=160&height=120`` or
``synthetic:ring?frames=600&walls=bare``; the fields of :class:`CorridorOptions` and :class:`RingOptions` are
the options.

Plan frame of the corridor: x along it from its west end, y to the north from its middle, z up from the floor.
Every room is a variation of the synthetic room: turned about the vertical, mirrored, with another table and
without one piece of its furniture. Plan frame of the ring: the middle of the corridor is a rectangle, twice
as long as wide, around the origin. CORRIDOR_IN_WORLD and RING_IN_WORLD move them so that no wall lies on a
border of voxels of a round size.

The walk around the ring goes along a line of corners and a little further, so that the camera sees its first
metres again: rounded, at eye height, looking ahead and a little to all sides. Distances along it in metres
say where the walker is; how fast that goes is up to the caller.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.options import require
from taichi_mrf.datasets.synthetic.analytic_scene import Color, Point, Scene, Solid, translated
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions, open_scene
from taichi_mrf.datasets.synthetic.room_furniture import (
    CLOTH,
    DARK_WOOD,
    HEIGHT,
    LEAF,
    LENGTH,
    METAL,
    NEAR_WALL,
    PLASTER,
    WALL,
    WHITE,
    WIDTH,
    WOOD,
    box,
    coffee_table,
    cylinder,
    dining_table,
    lamps_plant_and_pillar,
    shelf,
    sideboard,
    sofa,
    sphere,
)  # fmt: skip
from taichi_mrf.geometry.poses import Pose, look_at

CORRIDOR_IN_WORLD: Point = (-3.027, 0.073, -1.211)
PITCH = LENGTH + WALL
"""From the middle of a room to that of the next on the same side."""

HALF_WIDTH = 1.0
"""Half the width of the corridor."""

DOOR_X, DOOR_WIDTH, DOOR_HEIGHT = 2.2, 0.92, 2.05
"""Of a room's doorway, in the room's frame before it is mirrored."""

EYE = 1.5
METRES_PER_RADIAN = 0.5
"""Metres of travel that take as many frames as a turn of one radian."""

CARPET: Color = (0.50, 0.52, 0.58)


@dataclass(frozen=True)
class Room:
    """The ``number``-th room, from 0. Its own frame has its origin in the middle of its floor and the doorway
    in the wall at its lowest y."""

    number: int

    @property
    def turned(self) -> bool:
        """True if it lies south of the corridor, by half a turn."""
        return self.number % 2 == 1

    @property
    def mirrored(self) -> bool:
        """True if x changes its sign."""
        return self.number // 2 % 2 == 1

    def to_plan(self, x: float, y: float) -> tuple[float, float]:
        """A place in the room -> in the plan."""
        x = -x if self.mirrored else x
        sign = -1.0 if self.turned else 1.0
        middle = (self.number // 2 + 0.5) * PITCH, sign * (HALF_WIDTH + WALL + WIDTH / 2)
        return middle[0] + sign * x, middle[1] + sign * y

    def heading(self, angle: float) -> float:
        """A direction in the room, as an angle from its x axis -> in the plan."""
        angle = math.pi - angle if self.mirrored else angle
        return angle + math.pi if self.turned else angle

    def place(self, solids: Iterable[Solid]) -> list[Solid]:
        """Solids of the room's frame, in the plan's."""
        placed = []
        for solid in solids:
            x, y = self.to_plan(*solid.center[:2])
            yaw = -solid.yaw if self.mirrored else solid.yaw
            placed.append(replace(solid, center=(x, y, solid.center[2]), yaw=yaw))
        return placed


def corridor_length(rooms: int) -> float:
    """Metres from end to end."""
    return -(-rooms // 2) * PITCH


def corridor_scene(rooms: int) -> Scene:
    """The corridor with its rooms in the world frame."""
    solids = _shell(rooms)
    for number in range(rooms):
        room = Room(number)
        solids += room.place([*_walls(), *_furniture(number)])
    if rooms % 2:
        middle = corridor_length(rooms) - PITCH / 2
        solids.append(box(middle, -HALF_WIDTH - WALL / 2, 0, (PITCH, WALL, HEIGHT), PLASTER))
    return Scene(translated(solids, CORRIDOR_IN_WORLD), light=CORRIDOR_IN_WORLD)


def _shell(rooms: int) -> list[Solid]:
    """Floor, ceiling and the corridor's two ends."""
    length, across = corridor_length(rooms) + 2 * WALL, 2 * (HALF_WIDTH + WIDTH + 2 * WALL)
    middle = corridor_length(rooms) / 2
    floor = Solid(
        "box", (middle, 0, -WALL / 2), (length / 2, across / 2, WALL / 2), color=CARPET, checker=0.5
    )
    ends = [box(x, 0, 0, (WALL, 2 * HALF_WIDTH, HEIGHT), PLASTER) for x in (-WALL / 2, 2 * middle + WALL / 2)]
    return [floor, box(middle, 0, HEIGHT, (length, across, WALL), WHITE), *ends]


def _walls() -> list[Solid]:
    """The walls of a room, one of them with a doorway."""
    outer, half = LENGTH + 2 * WALL, (LENGTH + WALL) / 2
    front, back = -(WIDTH + WALL) / 2, (WIDTH + WALL) / 2
    left = DOOR_X - DOOR_WIDTH / 2 + outer / 2
    right = outer - left - DOOR_WIDTH
    return [
        box(0, back, 0, (outer, WALL, HEIGHT), PLASTER),
        box(-half, 0, 0, (WALL, WIDTH + 2 * WALL, HEIGHT), PLASTER),
        box(half, 0, 0, (WALL, WIDTH + 2 * WALL, HEIGHT), (0.70, 0.76, 0.72)),
        box(-outer / 2 + left / 2, front, 0, (left, WALL, HEIGHT), PLASTER),
        box(outer / 2 - right / 2, front, 0, (right, WALL, HEIGHT), PLASTER),
        box(DOOR_X, front, DOOR_HEIGHT, (DOOR_WIDTH, WALL, HEIGHT - DOOR_HEIGHT), PLASTER),
    ]


def _furniture(number: int) -> list[Solid]:
    groups = [
        dining_table(1.25, 0.85, yaw=0.3 + 0.4 * number),
        sofa(-2.5, -0.4),
        coffee_table(-1.25, -0.35),
        shelf(-1.3, 2.3),
        sideboard(0.0, -2.22),
        lamps_plant_and_pillar(),
    ]
    del groups[number % len(groups)]
    return [solid for group in groups for solid in group]


Waypoint = tuple[float, float, float, float, float]
"""x, y, z of the eye in the plan, heading and pitch in radians."""


def _room_waypoints(room: Room) -> list[Waypoint]:
    """From the corridor through the doorway, once around the middle of the room, and out again."""
    front = -WIDTH / 2 - WALL
    door = (*room.to_plan(DOOR_X, front + WALL / 2), EYE)
    inside = (*room.to_plan(2.05, -1.95), EYE)
    corridor = (*room.to_plan(DOOR_X, front - HALF_WIDTH), EYE)
    begin = -0.6
    path: list[Waypoint] = [
        (*corridor, room.heading(math.pi / 2), -0.1),
        (*door, room.heading(0.55 * math.pi), -0.15),
        (*inside, room.heading(0.65 * math.pi), -0.2),
    ]
    for a in np.linspace(begin, begin + 2 * math.pi, 25).tolist():
        place = room.to_plan(1.45 * math.cos(a) - 0.1, 1.0 * math.sin(a) - 0.35)
        heading = a + math.pi + 0.35 * math.sin(2 * a)
        path.append(
            (*place, EYE + 0.12 * math.sin(2 * a), room.heading(heading), -0.24 + 0.2 * math.sin(3 * a))
        )
    path += [
        (*inside, room.heading(1.1 * math.pi), -0.2),
        (*door, room.heading(1.5 * math.pi), -0.1),
        (*corridor, room.heading(1.5 * math.pi), -0.1),
    ]
    return path


def waypoints(rooms: int) -> NDArray[np.float64]:
    """(n, 5): the path from the west end into each room, as its doorway comes, to the east end."""
    numbers = sorted(range(rooms), key=lambda number: Room(number).to_plan(DOOR_X, 0.0)[0])
    length = corridor_length(rooms)
    path: list[Waypoint] = [(0.6, 0.0, EYE, 0.0, -0.1)]
    for number in numbers:
        into = _room_waypoints(Room(number))
        # Along the corridor the camera looks where it goes; at the door it turns.
        path += [(into[0][0] - 0.5, 0.0, EYE, 0.0, -0.1), *into, (into[-1][0] + 0.5, 0.0, EYE, 0.0, -0.1)]
    path += [(length - 0.6, 0.0, EYE, 0.0, -0.1), (length - 0.6, 0.0, EYE, math.pi, -0.1)]
    table = np.array(path)
    table[:, 3] = np.unwrap(table[:, 3])
    return table


def pose_on_path(path: NDArray[np.float64], phase: float) -> Pose:
    """T_world_camera at ``phase`` of a path (n, 5), 0 to 1: at even speed, turning included."""
    steps = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)
    steps += METRES_PER_RADIAN * np.abs(np.diff(path[:, 3]))
    reached = np.concatenate([[0.0], np.cumsum(steps)])
    x, y, z, heading, pitch = (np.interp(phase * reached[-1], reached, path[:, i]) for i in range(5))
    eye = np.array([x, y, z]) + CORRIDOR_IN_WORLD
    return look_at(eye, eye + np.array([math.cos(heading), math.sin(heading), math.tan(pitch)]))


STEP_M = 0.02
"""Between neighbouring points of the path."""


class SmoothPath:
    """The path past some corners, (n, 2) in metres, over a floor at ``floor_z``."""

    def __init__(
        self, corners: Sequence[tuple[float, float]], rounding_m: float = 3.0, floor_z: float = 0.0
    ) -> None:
        """Positions and headings are averaged over ``rounding_m`` metres."""
        table = np.asarray(corners, np.float64)
        reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(table, axis=0), axis=1))])
        window = np.hanning(2 * round(rounding_m / STEP_M / 2) + 1)
        window /= window.sum()
        margin = len(window) // 2 * STEP_M
        along = np.arange(-2 * margin, reached[-1] + 2 * margin, STEP_M)
        line = np.stack([_beyond(along, reached, table[:, axis]) for axis in (0, 1)], axis=1)
        smooth = np.stack([np.convolve(line[:, axis], window, "valid") for axis in (0, 1)], axis=1)
        steps = np.diff(smooth, axis=0)
        heading = np.convolve(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])), window, "valid")
        kept = smooth[len(window) // 2 :][: len(heading)]
        self._places = kept
        self._headings = heading
        self._reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(kept, axis=0), axis=1))])
        self._eye_z = floor_z + EYE

    @property
    def length_m(self) -> float:
        """From its beginning to its end."""
        return float(self._reached[-1])

    def pose_at(self, metres: float) -> Pose:
        """T_world_camera, (4, 4), at so many metres from the beginning."""
        x, y = (np.interp(metres, self._reached, self._places[:, axis]) for axis in (0, 1))
        heading = np.interp(metres, self._reached, self._headings) + 0.25 * math.sin(metres / 0.9)
        pitch = -0.15 + 0.1 * math.sin(metres / 1.3)
        eye = np.array([x, y, self._eye_z + 0.03 * math.sin(metres / 0.4)])
        return look_at(eye, eye + np.array([math.cos(heading), math.sin(heading), math.tan(pitch)]))


def _beyond(
    along: NDArray[np.float64], reached: NDArray[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Linear interpolation that goes on straight beyond both ends."""
    inside = np.interp(along, reached, values)
    first = (values[1] - values[0]) / (reached[1] - reached[0])
    last = (values[-1] - values[-2]) / (reached[-1] - reached[-2])
    return inside + first * np.minimum(along, 0.0) + last * np.maximum(along - reached[-1], 0.0)


RING_IN_WORLD: Point = (0.113, -0.087, -1.211)

OVERLAP_M = 3.0
"""Metres of its beginning that the camera walks a second time."""

NEAREST_M, FURTHEST_M = 1.3, 2.4
"""Between what stands along one wall."""

BOARDS: tuple[Color, ...] = ((0.85, 0.62, 0.30), (0.62, 0.78, 0.92), (0.75, 0.30, 0.25), CLOTH)


def ring_scene(length_m: float, bare: bool = False) -> Scene:
    """The corridor, ``length_m`` metres once around, in the world frame; ``bare``: its walls alone."""
    solids = _ring_shell(*_half_sizes(length_m))
    if not bare:
        solids += _along_the_walls(*_half_sizes(length_m))
    return Scene(translated(solids, RING_IN_WORLD), light=RING_IN_WORLD)


def ring_path(length_m: float) -> SmoothPath:
    """Once around, counter-clockwise from the middle of the south side, and OVERLAP_M further."""
    a, b = _half_sizes(length_m)
    corners = [(0.0, -b), (a, -b), (a, b), (-a, b), (-a, -b), (OVERLAP_M, -b)]
    x, y, z = RING_IN_WORLD
    return SmoothPath([(x + u, y + v) for u, v in corners], floor_z=z)


def _half_sizes(length_m: float) -> tuple[float, float]:
    """Half the sides of the rectangle in the middle of the corridor."""
    return length_m / 6, length_m / 12


def _ring_shell(a: float, b: float) -> list[Solid]:
    outer, inner = (2 * (a + HALF_WIDTH), 2 * (b + HALF_WIDTH)), (2 * (a - HALF_WIDTH), 2 * (b - HALF_WIDTH))
    wide, deep = outer[0] + 2 * WALL, outer[1] + 2 * WALL
    floor = Solid("box", (0, 0, -WALL / 2), (wide / 2, deep / 2, WALL / 2), color=CARPET, checker=0.5)
    walls = [box(s * (outer[0] + WALL) / 2, 0, 0, (WALL, deep, HEIGHT), PLASTER) for s in (-1, 1)]
    walls += [box(0, s * (outer[1] + WALL) / 2, 0, (wide, WALL, HEIGHT), PLASTER) for s in (-1, 1)]
    return [
        floor,
        box(0, 0, HEIGHT, (wide, deep, WALL), WHITE),
        *walls,
        box(0, 0, 0, (*inner, HEIGHT), NEAR_WALL),
    ]


def _along_the_walls(a: float, b: float) -> list[Solid]:
    """Doors, pillars, boards and furniture, unevenly spaced, along both walls of all four sides."""
    random = np.random.default_rng(19)
    solids = []
    for side in range(4):
        length = 2 * (b if side % 2 else a)
        across = a if side % 2 else b
        for wall in (-1, 1):  # the block's, the outer one
            reach = length / 2 - HALF_WIDTH if wall < 0 else length / 2 + HALF_WIDTH
            place = -reach + random.uniform(0.8, 1.5)
            while place < reach - 0.8:
                pieces = _piece(int(random.integers(6)), random)
                solids += [_placed(piece, place, across, wall, side) for piece in pieces]
                place += random.uniform(NEAREST_M, FURTHEST_M)
    return solids


def _piece(kind: int, random: np.random.Generator) -> list[Solid]:
    """Something that stands against a wall: x along the wall, y from the wall into the corridor."""
    color = BOARDS[int(random.integers(len(BOARDS)))]
    if kind == 0:  # a door in its frame
        frame = [box(s * 0.5, 0.05, 0, (0.08, 0.10, 2.1), WHITE) for s in (-1, 1)]
        top = box(0, 0.05, 2.1, (1.08, 0.10, 0.08), WHITE)
        return [
            box(0, 0.02, 0, (0.92, 0.04, 2.1), DARK_WOOD),
            top,
            *frame,
            sphere(0.38, 0.09, 1.05, 0.04, METAL),
        ]
    if kind == 1:  # a pillar
        side = float(random.uniform(0.22, 0.4))
        return [box(0, side / 2, 0, (side, side, HEIGHT), PLASTER)]
    if kind == 2:  # a notice board
        return [box(0, 0.03, 1.1, (float(random.uniform(0.7, 1.2)), 0.06, 0.8), color)]
    if kind == 3:  # a bench
        legs = [box(s * 0.45, 0.2, 0, (0.06, 0.34, 0.42), METAL) for s in (-1, 1)]
        return [box(0, 0.2, 0.42, (1.1, 0.38, 0.05), WOOD), *legs]
    if kind == 4:  # a plant
        return [
            cylinder(0, 0.25, 0, 0.18, 0.4, (0.70, 0.38, 0.26)),
            cylinder(0, 0.25, 0.4, 0.03, 0.4, DARK_WOOD),
            sphere(0, 0.25, 1.0, float(random.uniform(0.18, 0.26)), LEAF),
        ]
    width, height = float(random.uniform(0.5, 0.9)), float(random.uniform(0.8, 1.8))  # a cupboard
    return [box(0, 0.175, 0, (width, 0.35, height), color)]


def _placed(solid: Solid, along: float, across: float, wall: int, side: int) -> Solid:
    """A piece at ``along`` metres from the middle of a side. The middle of the corridor there is ``across``
    metres from the origin; the sides are those to the south, east, north and west."""
    x, y, z = solid.center
    inwards = -across - wall * (HALF_WIDTH - y)  # in the plan of the south side
    along += wall * x
    yaw = side * math.pi / 2
    c, s = math.cos(yaw), math.sin(yaw)
    return replace(solid, center=(c * along - s * inwards, s * along + c * inwards, z), yaw=solid.yaw + yaw)


LAMP_OVER_EYE_M = 0.6


@dataclass
class Walked(RenderedSequence):
    """A walk as a sequence of frames, from beginning to end, in the light of a lamp over the camera."""

    def lit(self, scene: Scene, T_world_camera: Pose) -> Scene:
        x, y, z = T_world_camera[:3, 3].tolist()
        return replace(scene, light=(x, y, z + LAMP_OVER_EYE_M))


@dataclass(frozen=True)
class CorridorOptions(RenderOptions):
    """The options of the built-in corridor."""

    frames: int = 600
    """Views, evenly spread over the camera's path; 540 are left for the map when one in ten is kept out."""

    rooms: int = 12
    """Rooms off the corridor, which is 6.15 m long for every two."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, rooms=1)


@dataclass
class SyntheticCorridor(Walked):
    """The walk through the corridor."""

    options: CorridorOptions = CorridorOptions()

    @cached_property
    def scene(self) -> Scene:
        return corridor_scene(self.options.rooms)

    @cached_property
    def _camera_path(self) -> NDArray[np.float64]:
        return waypoints(self.options.rooms)

    def pose_at(self, index: int) -> Pose:
        return pose_on_path(self._camera_path, index / max(1, self.options.frames - 1))


@dataclass(frozen=True)
class RingOptions(RenderOptions):
    """The options of the built-in ring corridor."""

    frames: int = 600
    """Views, evenly spread over the camera's path."""

    length: float = 60.0
    """Metres once around, along the middle of the corridor."""

    walls: Literal["furnished", "bare"] = "furnished"
    """Doors, pillars and furniture along the walls, or nothing but the walls."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, length=24)


@dataclass
class SyntheticRing(Walked):
    """The walk around the ring."""

    options: RingOptions = RingOptions()

    @cached_property
    def scene(self) -> Scene:
        return ring_scene(self.options.length, bare=self.options.walls == "bare")

    @cached_property
    def camera_path(self) -> SmoothPath:
        """Path of the camera in the world frame."""
        return ring_path(self.options.length)

    def pose_at(self, index: int) -> Pose:
        return self.camera_path.pose_at(self.camera_path.length_m * index / max(1, self.options.frames - 1))


NAME = "synthetic:corridor"
open_synthetic_corridor = partial(open_scene, SyntheticCorridor, NAME)
open_synthetic_ring = partial(open_scene, SyntheticRing, "synthetic:ring")
