"""A scene of solids whose surfaces are known exactly: boxes turned about the vertical, spheres and
upright cylinders.

Everything here is NumPy; ``analytic_render`` takes pictures of it. World frame with z up, metres.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Kind = Literal["box", "sphere", "cylinder"]
KINDS: tuple[Kind, ...] = ("box", "sphere", "cylinder")
"""A solid's kind in :attr:`Scene.geometry` is its place in this tuple."""

Point = tuple[float, float, float]
Color = tuple[float, float, float]


@dataclass(frozen=True)
class Solid:
    """One solid. ``half_size`` is half its extent along its own x, y, z (a sphere's and a cylinder's x is
    the radius). ``yaw`` turns it about the vertical, in radians. ``color`` is RGB from 0 to 1;
    ``checker`` is the edge in metres of the squares that it is painted with, 0 for plain."""

    kind: Kind
    center: Point
    half_size: Point
    yaw: float = 0.0
    color: Color = (0.7, 0.7, 0.7)
    checker: float = 0.0


@dataclass(frozen=True)
class Scene:
    """The union of some solids, and a lamp at ``light`` that the pictures are shaded with."""

    solids: tuple[Solid, ...]
    light: Point

    @cached_property
    def geometry(self) -> NDArray[np.float32]:
        """(solids, 10) for the renderer: kind, centre x y z, half size x y z, cos yaw, sin yaw, squared
        radius of a ball around the solid (a thousandth too large, so that rounding cuts nothing off)."""
        rows = [
            (
                KINDS.index(s.kind),
                *s.center,
                *s.half_size,
                math.cos(s.yaw),
                math.sin(s.yaw),
                1.001 * ball_radius(s) ** 2,
            )
            for s in self.solids
        ]
        return np.array(rows, dtype=np.float32)

    @cached_property
    def materials(self) -> NDArray[np.float32]:
        """(solids, 4) for the renderer: red, green, blue, checker edge."""
        return np.array([(*s.color, s.checker) for s in self.solids], dtype=np.float32)

    def signed_distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Distance to the nearest surface, (N,) in metres, of points (N, 3); negative inside a solid. Outside
        it is exact. Inside, where solids overlap, the true distance to the free space may be larger in size
        (the minimum over solids is a bound), but the sign is always right."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        nearest = np.full(len(points), np.inf)
        for radius, solid in sorted(((ball_radius(s), s) for s in self.solids), key=lambda pair: -pair[0]):
            # No point of a solid is nearer than the ball around it, so most need no closer look.
            to_center, reach = points - solid.center, np.maximum(nearest + radius, 0.0)
            near = np.einsum("ij,ij->i", to_center, to_center) < reach * reach
            if near.any():
                nearest[near] = np.minimum(nearest[near], distance_to(solid, points[near]))
        return nearest


def ball_radius(solid: Solid) -> float:
    """Radius of a ball about the solid's centre that holds all of it."""
    return math.sqrt(sum(half * half for half in solid.half_size))


def distance_to(solid: Solid, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance, (N,), of points (N, 3) to one solid's surface, exact on both sides."""
    local = points - solid.center
    if solid.kind == "sphere":
        return np.linalg.norm(local, axis=1) - solid.half_size[0]
    if solid.kind == "cylinder":
        radial = np.linalg.norm(local[:, :2], axis=1) - solid.half_size[0]
        beyond = np.stack([radial, np.abs(local[:, 2]) - solid.half_size[2]], axis=1)
    else:
        c, s = math.cos(solid.yaw), math.sin(solid.yaw)
        local[:, :2] = local[:, :2] @ np.array([[c, -s], [s, c]])
        beyond = np.abs(local) - solid.half_size
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


def translated(solids: Iterable[Solid], offset: Point) -> tuple[Solid, ...]:
    """Copy of the solids, moved."""
    moved = []
    for s in solids:
        center = (s.center[0] + offset[0], s.center[1] + offset[1], s.center[2] + offset[2])
        moved.append(replace(s, center=center))
    return tuple(moved)
