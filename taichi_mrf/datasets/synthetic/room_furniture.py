"""The furniture of the synthetic room, and the camera's path through it.

Furniture is placed in the room's own frame: x and y from the middle of the floor, z up from the floor.
ROOM_IN_WORLD moves it all so that the world's origin lies inside the room, half way up, and no wall
lies on a border of voxels of a round size.
"""

import math
from collections.abc import Sequence

import numpy as np

from taichi_mrf.datasets.synthetic.analytic_scene import Color, Point, Scene, Solid, translated
from taichi_mrf.geometry.poses import Pose, look_at

LENGTH, WIDTH, HEIGHT = 6.0, 5.0, 2.7
WALL = 0.15
ROOM_IN_WORLD: Point = (0.173, -0.127, -1.211)

WOOD: Color = (0.62, 0.42, 0.25)
DARK_WOOD: Color = (0.40, 0.26, 0.16)
WHITE: Color = (0.92, 0.91, 0.88)
PLASTER: Color = (0.87, 0.83, 0.74)
METAL: Color = (0.45, 0.46, 0.48)
CLOTH: Color = (0.24, 0.37, 0.55)
LEAF: Color = (0.22, 0.50, 0.24)
NEAR_WALL: Color = (0.70, 0.76, 0.72)


def room_scene() -> Scene:
    """The furnished room in the world frame, lit by a lamp under the ceiling."""
    x, y, z = ROOM_IN_WORLD
    return Scene(translated(room_solids(), ROOM_IN_WORLD), light=(x - 0.2, y - 0.3, z + 2.5))


def room_solids(doorway: Sequence[Solid] = ()) -> list[Solid]:
    """All solids in the room's own frame. ``doorway`` replaces the wall at the lowest y and its door."""
    return [
        *_shell(doorway or [_near_wall()]),
        *(() if doorway else _shut_door()),
        *_window_and_picture(),
        *dining_table(1.25, 0.85, yaw=0.3),
        *sofa(-2.5, -0.4),
        *coffee_table(-1.25, -0.35),
        *shelf(-1.3, 2.3),
        *sideboard(0.0, -2.22),
        *lamps_plant_and_pillar(),
    ]


def camera_pose(phase: float) -> Pose:
    """T_world_camera at ``phase`` of the path, 0 to 1, a closed loop: around the middle of the room at eye
    height, looking across to the other side, up and down by turns."""
    a = 2 * math.pi * phase
    eye = np.array([1.45 * math.cos(a) - 0.1, 1.0 * math.sin(a) - 0.35, 1.5 + 0.12 * math.sin(2 * a)])
    heading = a + math.pi + 0.35 * math.sin(2 * a)
    pitch = -0.24 + 0.2 * math.sin(3 * a)
    ahead = [math.cos(heading), math.sin(heading), math.tan(pitch)]
    return look_at(eye + ROOM_IN_WORLD, eye + ROOM_IN_WORLD + ahead)


def box(x: float, y: float, bottom: float, size: Point, color: Color, yaw: float = 0.0) -> Solid:
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Solid("box", (x, y, bottom + half[2]), half, yaw, color)


def cylinder(x: float, y: float, bottom: float, radius: float, height: float, color: Color) -> Solid:
    return Solid("cylinder", (x, y, bottom + height / 2), (radius, radius, height / 2), 0.0, color)


def sphere(x: float, y: float, z: float, radius: float, color: Color) -> Solid:
    return Solid("sphere", (x, y, z), (radius, radius, radius), 0.0, color)


def _turned(x: float, y: float, yaw: float, dx: float, dy: float) -> tuple[float, float]:
    """The place at (dx, dy) in the frame of a piece of furniture at (x, y) with this yaw."""
    c, s = math.cos(yaw), math.sin(yaw)
    return x + c * dx - s * dy, y + s * dx + c * dy


def _near_wall() -> Solid:
    return box(0, -(WIDTH + WALL) / 2, 0, (LENGTH + 2 * WALL, WALL, HEIGHT), NEAR_WALL)


def _shell(near_wall: Sequence[Solid]) -> list[Solid]:
    outer = (LENGTH + 2 * WALL, WIDTH + 2 * WALL)
    across = (LENGTH + WALL) / 2, (WIDTH + WALL) / 2
    floor_half: Point = (outer[0] / 2, outer[1] / 2, WALL / 2)
    return [
        Solid("box", (0, 0, -WALL / 2), floor_half, color=(0.72, 0.56, 0.40), checker=0.5),
        box(0, 0, HEIGHT, (*outer, WALL), WHITE),
        box(-across[0], 0, 0, (WALL, outer[1], HEIGHT), PLASTER),
        box(across[0], 0, 0, (WALL, outer[1], HEIGHT), PLASTER),
        *near_wall,
        box(0, across[1], 0, (outer[0], WALL, HEIGHT), PLASTER),
    ]


def _shut_door() -> list[Solid]:
    return [box(2.2, -2.47, 0, (0.92, 0.06, 2.05), DARK_WOOD), sphere(1.85, -2.40, 1.05, 0.035, METAL)]


def _window_and_picture() -> list[Solid]:
    return [
        box(2.98, -0.1, 0.95, (0.04, 1.7, 1.2), (0.62, 0.78, 0.92)),
        box(2.96, -0.1, 0.95, (0.06, 0.05, 1.2), WHITE),
        box(2.96, -0.1, 1.52, (0.06, 1.7, 0.05), WHITE),
        box(2.90, -0.1, 0.90, (0.20, 1.9, 0.05), WHITE),
        box(0.9, 2.48, 1.30, (1.2, 0.04, 0.8), DARK_WOOD),
        box(0.9, 2.465, 1.36, (1.08, 0.04, 0.68), (0.85, 0.62, 0.30)),
    ]


def _legs(x: float, y: float, yaw: float, dx: float, dy: float, side: float, height: float) -> list[Solid]:
    places = [_turned(x, y, yaw, i * dx, j * dy) for i in (-1, 1) for j in (-1, 1)]
    return [box(*place, 0, (side, side, height), WOOD, yaw) for place in places]


def dining_table(x: float, y: float, yaw: float) -> list[Solid]:
    solids = [box(x, y, 0.72, (1.5, 0.85, 0.04), WOOD, yaw), *_legs(x, y, yaw, 0.68, 0.36, 0.06, 0.72)]
    for dx, dy, turn in ((-0.38, -0.62, 0.1), (0.38, -0.64, -0.15), (-0.36, 0.62, 3.1), (0.4, 0.66, 3.3)):
        solids += chair(*_turned(x, y, yaw, dx, dy), yaw + turn)
    vase = _turned(x, y, yaw, 0.1, 0.05)
    solids += [cylinder(*vase, 0.76, 0.06, 0.22, (0.75, 0.30, 0.25)), sphere(*vase, 1.06, 0.11, LEAF)]
    solids.append(cylinder(*_turned(x, y, yaw, -0.45, -0.15), 0.76, 0.13, 0.02, WHITE))
    return solids


def chair(x: float, y: float, yaw: float) -> list[Solid]:
    back = _turned(x, y, yaw, 0.0, -0.19)
    return [
        box(x, y, 0.43, (0.42, 0.42, 0.04), CLOTH, yaw),
        box(*back, 0.47, (0.42, 0.035, 0.45), WOOD, yaw),
        *_legs(x, y, yaw, 0.18, 0.18, 0.04, 0.43),
    ]


def sofa(x: float, y: float) -> list[Solid]:
    arms = [box(x, y + side * 0.95, 0, (0.85, 0.18, 0.62), CLOTH) for side in (-1, 1)]
    return [
        box(x, y, 0.05, (0.85, 1.9, 0.25), CLOTH),
        box(x + 0.10, y - 0.43, 0.30, (0.62, 0.83, 0.14), (0.30, 0.44, 0.62)),
        box(x + 0.10, y + 0.43, 0.30, (0.62, 0.83, 0.14), (0.30, 0.44, 0.62)),
        box(x - 0.33, y, 0.30, (0.20, 1.9, 0.52), CLOTH),
        *arms,
        box(x - 0.12, y + 0.62, 0.44, (0.14, 0.42, 0.40), (0.86, 0.66, 0.28), yaw=0.25),
    ]


def coffee_table(x: float, y: float) -> list[Solid]:
    return [
        cylinder(x, y, 0, 1.0, 0.012, (0.62, 0.28, 0.26)),
        box(x, y, 0.38, (0.60, 1.0, 0.04), DARK_WOOD),
        *_legs(x, y, 0.0, 0.25, 0.45, 0.05, 0.38),
        box(x + 0.05, y - 0.25, 0.42, (0.21, 0.29, 0.05), (0.75, 0.25, 0.22), yaw=0.4),
        box(x + 0.03, y - 0.24, 0.47, (0.18, 0.25, 0.03), (0.25, 0.35, 0.60), yaw=-0.2),
        sphere(x - 0.02, y + 0.25, 0.51, 0.09, (0.90, 0.58, 0.18)),
    ]


def shelf(x: float, y: float) -> list[Solid]:
    """A shelf of 1.6 x 0.36 x 2 m against the far wall; books of several heights, two boxes, a ball."""
    solids = [box(x + side * 0.79, y, 0, (0.03, 0.36, 2.0), WHITE) for side in (-1, 1)]
    solids.append(box(x, y + 0.17, 0, (1.6, 0.02, 2.0), WHITE))
    boards = (0.06, 0.52, 0.98, 1.44, 1.97)
    solids += [box(x, y, z, (1.55, 0.34, 0.03), WHITE) for z in boards]
    colors: tuple[Color, ...] = (CLOTH, (0.72, 0.24, 0.20), LEAF, (0.85, 0.70, 0.35), DARK_WOOD)
    for shelf, (first, count) in enumerate(((-0.70, 0), (-0.70, 6), (-0.10, 7), (-0.70, 5))):
        for i in range(count):
            height = 0.24 + 0.025 * ((3 * i + 2 * shelf) % 5)
            place = first + 0.085 * i
            color = colors[(i + 2 * shelf) % len(colors)]
            solids.append(box(x + place, y + 0.02, boards[shelf] + 0.03, (0.07, 0.22, height), color))
    solids += [
        box(x - 0.40, y, 0.09, (0.55, 0.30, 0.32), (0.80, 0.72, 0.55)),
        box(x + 0.35, y, 0.09, (0.45, 0.28, 0.25), (0.50, 0.60, 0.45)),
        box(x - 0.45, y, 1.01, (0.30, 0.25, 0.22), (0.80, 0.72, 0.55), yaw=0.3),
        sphere(x + 0.40, y, 1.60, 0.13, (0.85, 0.45, 0.20)),
    ]
    return solids


def sideboard(x: float, y: float) -> list[Solid]:
    """A low sideboard with a screen on it."""
    return [
        box(x, y, 0.08, (1.8, 0.45, 0.47), WOOD),
        box(x, y, 0, (1.7, 0.38, 0.08), DARK_WOOD),
        box(x, y - 0.02, 0.55, (0.40, 0.22, 0.03), METAL),
        box(x, y - 0.05, 0.58, (0.06, 0.05, 0.10), METAL),
        box(x, y - 0.03, 0.66, (1.15, 0.05, 0.66), (0.10, 0.10, 0.12)),
        cylinder(x + 0.75, y, 0.55, 0.08, 0.30, (0.55, 0.62, 0.70)),
    ]


def lamps_plant_and_pillar() -> list[Solid]:
    return [
        # floor lamp in the corner behind the sofa
        cylinder(-2.55, 1.15, 0, 0.16, 0.03, METAL),
        cylinder(-2.55, 1.15, 0.03, 0.02, 1.45, METAL),
        sphere(-2.55, 1.15, 1.60, 0.19, (0.98, 0.93, 0.75)),
        # lamp above the dining table
        cylinder(1.25, 0.85, 2.05, 0.012, 0.65, METAL),
        sphere(1.25, 0.85, 1.95, 0.15, (0.98, 0.85, 0.55)),
        # plant between the window and the door
        cylinder(2.60, -1.65, 0, 0.19, 0.38, (0.70, 0.38, 0.26)),
        cylinder(2.60, -1.65, 0.38, 0.03, 0.45, DARK_WOOD),
        sphere(2.60, -1.65, 1.02, 0.28, LEAF),
        sphere(2.48, -1.52, 1.30, 0.18, (0.28, 0.58, 0.28)),
        sphere(2.70, -1.72, 1.38, 0.16, LEAF),
        # pillar in a corner, ball and stool on the floor
        cylinder(2.70, 2.20, 0, 0.17, HEIGHT, PLASTER),
        sphere(-0.55, 1.10, 0.14, 0.14, (0.85, 0.25, 0.22)),
        cylinder(-2.30, -1.95, 0, 0.22, 0.45, (0.80, 0.62, 0.42)),
    ]
