"""The built-in room with things that come, go and are moved, a door that opens and closes, and a person.

Places are in the room's own frame, as in room_furniture. A ``variant`` (any number) turns the same script
into another scene: other places, other times, another start of the camera.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid, translated
from taichi_mrf.datasets.synthetic.moving_scene import (
    MovingScene,
    Place,
    Stay,
    Sway,
    Thing,
    placed,
    way,
)
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
    chair,
    cylinder,
    room_solids,
    sphere,
)

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
