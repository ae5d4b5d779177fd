"""A scene that changes: solids as a function of time, and the truth about them.

A thing is a rigid group of solids that stands or moves on straight ways, and is absent in between. World
frame with z up, metres and seconds. Everything here is NumPy.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.datasets.synthetic.analytic_scene import Point, Scene, Solid
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
        ways = (
            (self.x, other.x),
            (self.y, other.y),
            (self.z, other.z),
            (self.yaw, other.yaw),
        )
        return Place(*(a + share * (b - a) for a, b in ways))


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
    seconds; ``camera`` is the way of a camera that sees it happen."""

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
