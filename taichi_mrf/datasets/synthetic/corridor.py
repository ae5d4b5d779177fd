"""``synthetic:corridor``: a long walk through a corridor and the furnished rooms off it, with ground truth.

Options follow a question mark, ``synthetic:corridor?rooms=4&frames=200&width=160&height=120``; the fields of
:class:`CorridorOptions` are the options.

Plan frame: x along the corridor from its west end, y to the north from its middle, z up from the floor.
Every room is a variation of the synthetic room: turned about the vertical, mirrored, with another table and
without one piece of its furniture. CORRIDOR_IN_WORLD moves it all so that no wall lies on a border of voxels
of a round size.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.synthetic.analytic_scene import Color, Point, Scene, Solid, translated
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions
from taichi_mrf.datasets.synthetic.room_furniture import (
    HEIGHT,
    LENGTH,
    PLASTER,
    WALL,
    WHITE,
    WIDTH,
    box,
    coffee_table,
    dining_table,
    lamps_plant_and_pillar,
    shelf,
    sideboard,
    sofa,
)
from taichi_mrf.errors import DatasetError
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


def floor_area_m2(rooms: int) -> float:
    """Floor of the corridor and its rooms, without walls."""
    return 2 * HALF_WIDTH * corridor_length(rooms) + rooms * LENGTH * WIDTH


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
    way: list[Waypoint] = [
        (*corridor, room.heading(math.pi / 2), -0.1),
        (*door, room.heading(0.55 * math.pi), -0.15),
        (*inside, room.heading(0.65 * math.pi), -0.2),
    ]
    for a in np.linspace(begin, begin + 2 * math.pi, 25).tolist():
        place = room.to_plan(1.45 * math.cos(a) - 0.1, 1.0 * math.sin(a) - 0.35)
        heading = a + math.pi + 0.35 * math.sin(2 * a)
        way.append(
            (*place, EYE + 0.12 * math.sin(2 * a), room.heading(heading), -0.24 + 0.2 * math.sin(3 * a))
        )
    way += [
        (*inside, room.heading(1.1 * math.pi), -0.2),
        (*door, room.heading(1.5 * math.pi), -0.1),
        (*corridor, room.heading(1.5 * math.pi), -0.1),
    ]
    return way


def waypoints(rooms: int) -> NDArray[np.float64]:
    """(n, 5): the way from the west end into each room, as its doorway comes, to the east end."""
    numbers = sorted(range(rooms), key=lambda number: Room(number).to_plan(DOOR_X, 0.0)[0])
    length = corridor_length(rooms)
    way: list[Waypoint] = [(0.6, 0.0, EYE, 0.0, -0.1)]
    for number in numbers:
        into = _room_waypoints(Room(number))
        # Along the corridor the camera looks where it goes; at the door it turns.
        way += [(into[0][0] - 0.5, 0.0, EYE, 0.0, -0.1), *into, (into[-1][0] + 0.5, 0.0, EYE, 0.0, -0.1)]
    way += [(length - 0.6, 0.0, EYE, 0.0, -0.1), (length - 0.6, 0.0, EYE, math.pi, -0.1)]
    table = np.array(way)
    table[:, 3] = np.unwrap(table[:, 3])
    return table


def pose_on_way(way: NDArray[np.float64], phase: float) -> Pose:
    """T_world_camera at ``phase`` of a way (n, 5), 0 to 1: at even speed, turning included."""
    steps = np.linalg.norm(np.diff(way[:, :3], axis=0), axis=1)
    steps += METRES_PER_RADIAN * np.abs(np.diff(way[:, 3]))
    reached = np.concatenate([[0.0], np.cumsum(steps)])
    x, y, z, heading, pitch = (np.interp(phase * reached[-1], reached, way[:, i]) for i in range(5))
    eye = np.array([x, y, z]) + CORRIDOR_IN_WORLD
    return look_at(eye, eye + np.array([math.cos(heading), math.sin(heading), math.tan(pitch)]))


NAME = "synthetic:corridor"
LAMP_OVER_EYE_M = 0.6


@dataclass(frozen=True)
class CorridorOptions(RenderOptions):
    """The options of the built-in corridor."""

    frames: int = 600
    """Views, evenly spread over the camera's way; 540 are left for the map when one in ten is kept out."""

    rooms: int = 12
    """Rooms off the corridor, which is 6.15 m long for every two."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(rooms=1)


@dataclass
class SyntheticCorridor(RenderedSequence):
    """The synthetic corridor as a sequence of frames, from its west end to its east end."""

    options: CorridorOptions = CorridorOptions()

    @cached_property
    def scene(self) -> Scene:
        """The corridor and its rooms, in the world frame."""
        return corridor_scene(self.options.rooms)

    def lit(self, scene: Scene, T_world_camera: Pose) -> Scene:
        """A scene in the light of a lamp over the camera."""
        x, y, z = T_world_camera[:3, 3].tolist()
        return replace(scene, light=(x, y, z + LAMP_OVER_EYE_M))

    @cached_property
    def _way(self) -> NDArray[np.float64]:
        return waypoints(self.options.rooms)

    def pose_at(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4)."""
        return pose_on_way(self._way, index / max(1, self.options.frames - 1))


def open_synthetic_corridor(query: str, options: ReadOptions) -> SyntheticCorridor:
    """Open the corridor with the options after the question mark of its name.

    Raises DatasetError for an option that does not exist (naming the nearest), a value of the wrong
    type or out of range, and for a depth scale, which rendered depth does not have.
    """
    if options.depth_scale is not None:
        raise DatasetError(f"{NAME}: takes no depth_scale: its depth is in metres")
    corridor = parse_options(CorridorOptions, query, NAME)
    return SyntheticCorridor(NAME, options.camera or corridor.camera(), options=corridor, color=options.color)
