"""``synthetic:ring``: once around a corridor that leads back to its beginning, with ground truth.

Options follow a question mark, ``synthetic:ring?frames=600&walls=bare``; the fields of :class:`RingOptions`
are the options. The way leads once around and a little further: the camera sees its first metres again.

Plan frame: the middle of the corridor is a rectangle, twice as long as wide, around the origin; z up from the
floor. RING_IN_WORLD moves it all so that no wall lies on a border of voxels of a round size.

The walk goes along a line of corners: rounded, at eye height, looking ahead and a little to all sides.
Distances along it in metres say where the walker is; how fast that goes is up to the caller.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.synthetic.analytic_scene import Color, Point, Scene, Solid, translated
from taichi_mrf.datasets.synthetic.corridor import CARPET, HALF_WIDTH
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions
from taichi_mrf.datasets.synthetic.room_furniture import (
    CLOTH,
    DARK_WOOD,
    HEIGHT,
    LEAF,
    METAL,
    NEAR_WALL,
    PLASTER,
    WALL,
    WHITE,
    WOOD,
    box,
    cylinder,
    sphere,
)
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, look_at

STEP_M = 0.02
"""Between neighbouring points of the way."""

EYE_M = 1.5


class SmoothWay:
    """The way past some corners, (n, 2) in metres, over a floor at ``floor_z``."""

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
        self._eye_z = floor_z + EYE_M

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
    solids = _shell(*_half_sizes(length_m))
    if not bare:
        solids += _along_the_walls(*_half_sizes(length_m))
    return Scene(translated(solids, RING_IN_WORLD), light=RING_IN_WORLD)


def ring_way(length_m: float) -> SmoothWay:
    """Once around, counter-clockwise from the middle of the south side, and OVERLAP_M further."""
    a, b = _half_sizes(length_m)
    corners = [(0.0, -b), (a, -b), (a, b), (-a, b), (-a, -b), (OVERLAP_M, -b)]
    x, y, z = RING_IN_WORLD
    return SmoothWay([(x + u, y + v) for u, v in corners], floor_z=z)


def _half_sizes(length_m: float) -> tuple[float, float]:
    """Half the sides of the rectangle in the middle of the corridor."""
    return length_m / 6, length_m / 12


def _shell(a: float, b: float) -> list[Solid]:
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


NAME = "synthetic:ring"
LAMP_OVER_EYE_M = 0.6


@dataclass(frozen=True)
class RingOptions(RenderOptions):
    """The options of the built-in ring corridor."""

    frames: int = 600
    """Views, evenly spread over the camera's way."""

    length: float = 60.0
    """Metres once around, along the middle of the corridor."""

    walls: Literal["furnished", "bare"] = "furnished"
    """Doors, pillars and furniture along the walls, or nothing but the walls."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(length=24)


@dataclass
class SyntheticRing(RenderedSequence):
    """The ring corridor as a sequence of frames."""

    options: RingOptions = RingOptions()

    @cached_property
    def scene(self) -> Scene:
        """The corridor in the world frame."""
        return ring_scene(self.options.length, bare=self.options.walls == "bare")

    @cached_property
    def way(self) -> SmoothWay:
        """Way of the camera in the world frame."""
        return ring_way(self.options.length)

    def lit(self, scene: Scene, T_world_camera: Pose) -> Scene:
        """A scene in the light of a lamp over the camera."""
        x, y, z = T_world_camera[:3, 3].tolist()
        return replace(scene, light=(x, y, z + LAMP_OVER_EYE_M))

    def pose_at(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4)."""
        return self.way.pose_at(self.way.length_m * index / max(1, self.options.frames - 1))


def open_synthetic_ring(query: str, options: ReadOptions) -> SyntheticRing:
    """Open the ring corridor with the options after the question mark of its name.

    Raises DatasetError for an option that does not exist (naming the nearest), a value of the wrong
    type or out of range, and for a depth scale, which rendered depth does not have.
    """
    if options.depth_scale is not None:
        raise DatasetError(f"{NAME}: takes no depth_scale: its depth is in metres")
    ring = parse_options(RingOptions, query, NAME)
    return SyntheticRing(NAME, options.camera or ring.camera(), options=ring, color=options.color)
