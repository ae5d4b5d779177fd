"""Paths of a ball straight through a thin thing, and past it, in a scene whose truth is known."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.thin_rooms import Scene, Sensor, Thing, View
from benchmarks.thin_shapes import Array, Box, Capsule

BALL_M = 0.1
"""Radius of the ball."""

SPARE_M = 0.1
"""Least room between the ball and everything on a path past a thing."""

APART_M = 0.05
"""Room between the ball and things of other kinds on a path through one."""

HALF_PATH_M = 0.2
LEAST_ENDS, LEAST_VIEWS = 10, 3
"""Measurements on a thing that its path must meet, and views that see each place of a path past it free."""

MOST_OF_A_KIND = 12


@dataclass(frozen=True, eq=False)
class Crossing:
    """Paths of one thing, each (2, 3) in the world, None where other matter is in the way or nothing was
    measured."""

    kind: str
    through_m: Array | None
    past_m: Array | None


def crossings(scene: Scene, sensor: Sensor, views: list[View]) -> list[Crossing]:
    """The paths of at most a dozen things of each kind."""
    ends_m = np.concatenate([view.points(sensor.camera) for view in views])
    of_thing = np.concatenate([view.thing[view.depth_m > 0] for view in views])
    order = np.argsort(of_thing, kind="stable")
    starts = np.searchsorted(of_thing[order], np.arange(len(scene.things) + 1))
    found: list[Crossing] = []
    by_kind: dict[str, list[int]] = {thing.kind: [] for thing in scene.thin}
    for i, thing in enumerate(scene.things):
        if thing.kind in by_kind:
            by_kind[thing.kind].append(i)
    for kind, things in by_kind.items():
        few = things[:: math.ceil(len(things) / MOST_OF_A_KIND)]
        for i in few:
            ends = ends_m[order[starts[i] : starts[i + 1]]]
            through, past = _through(scene, scene.things[i], ends), None
            if through is not None:
                past = _past(scene, scene.things[i], sensor, views)
            found.append(Crossing(kind, through, past))
    return found


def _ways(thing: Thing) -> Iterator[tuple[Array, Array, Array, float]]:
    """Where a path may cross a thing, its direction, and the direction and half width to pass it by."""
    shape = thing.shape
    if isinstance(shape, Capsule):
        axis, around = shape.frame[:, 2], _around(shape.frame[:, 2])
        for up, way in itertools.product((0.0, 0.3, -0.3, 0.6, -0.6), around):
            at = shape.centre_m + up * shape.half_m[2] * axis
            yield at, way, np.cross(way, axis), shape.radius_m
        return
    thinnest, middle, longest = np.argsort(shape.half_m) if isinstance(shape, Box) else (2, 0, 1)
    for side in (middle, longest):
        for sign in (1.0, -1.0):
            aside = sign * shape.frame[:, side]
            yield shape.centre_m, shape.frame[:, thinnest], aside, float(shape.half_m[side])


def _around(axis: Array) -> list[Array]:
    """Eight directions perpendicular to an axis, horizontal ones first."""
    level = np.cross(axis, [0.0, 0, 1])
    if np.linalg.norm(level) < 0.1:
        level = np.array([1.0, 0, 0])
    level /= np.linalg.norm(level)
    other = np.cross(axis, level)
    angles = np.concatenate([np.arange(4), np.arange(4) + 4]) * math.pi / 4
    return [math.cos(a) * level + math.sin(a) * other for a in angles]


def _path(at_m: Array, way: Array) -> tuple[Array, Array]:
    """Start and end (2, 3), and places 2 cm apart."""
    ends = at_m + HALF_PATH_M * np.array([-1.0, 1.0])[:, None] * way
    return ends, at_m + np.linspace(-HALF_PATH_M, HALF_PATH_M, 21)[:, None] * way


def _through(scene: Scene, thing: Thing, ends_m: Array) -> Array | None:
    others = [
        other
        for other in scene.things
        if other.kind != thing.kind and (not thing.part_of or other.part_of != thing.part_of)
    ]
    for at, way, _, _ in _ways(thing):
        path, places = _path(at, way)
        if (np.linalg.norm(ends_m - at, axis=1) <= BALL_M).sum() < LEAST_ENDS:
            continue
        if scene.clearance(places, others).min() >= BALL_M + APART_M:
            return path
    return None


def _past(scene: Scene, thing: Thing, sensor: Sensor, views: list[View]) -> Array | None:
    for at, way, aside, half in _ways(thing):
        for sign, further_m in itertools.product((1.0, -1.0), (0.0, 0.05, 0.1)):
            beside = at + sign * (half + BALL_M + SPARE_M + further_m) * aside
            path, places = _path(beside, way)
            if scene.clearance(places).min() < BALL_M + SPARE_M - 1e-6:
                continue
            if _seen_free(places[::10], sensor, views):
                return path
    return None


def _seen_free(places_m: Array, sensor: Sensor, views: list[View]) -> bool:
    """Whether three views look through balls at these places, at their middle and six points of each."""
    around = BALL_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    points = (places_m[:, None] + around).reshape(-1, 3)
    seen = np.zeros(len(points), int)
    for view in views:
        T = view.T_world_camera
        u, v, depth_m = sensor.camera.project((points - T[:3, 3]) @ T[:3, :3]).T
        inside = np.flatnonzero(~np.isnan(depth_m))
        true_m = view.true_m[np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)]
        seen[inside] += np.isfinite(true_m) & (true_m > depth_m[inside])
    return bool((seen >= LEAST_VIEWS).all())
