"""Rooms with thin things in them, and what a depth camera or a spinning lidar measures there.

The world has z up and metres. Everything follows from a seed. A measurement is the depth at which the central
ray of a pixel first meets something, with Gaussian noise: there are no flying pixels, poses are exact.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.thin_shapes import Array, Box, Capsule, Disc, Shape, frame_along
from taichi_mrf import PinholeCamera, SphericalCamera
from taichi_mrf.sensor.camera import Camera

TURN_RADIANS = math.radians(13)
"""Of the walls against the grid."""

SHIFT_M = np.array([0.013, 0.007, 0.021])
"""Of the whole scene, so that no face lies in the grid's planes."""

WALL = "wall"
WALL_M = 0.1
"""Thickness of walls, floor and ceiling."""

CLEAR_M = 0.35
"""A sensor is at least so far from everything."""

NEAR_M, FAR_M = 1.0, 4.0
"""Distance of what a camera looks at."""


@dataclass(frozen=True)
class Thing:
    """A shape of a kind, such as "leg" or "cable"."""

    kind: str
    shape: Shape
    part_of: str = ""
    """What it is a part of, such as a fence whose wires, rails and posts stand closer than a ball is wide."""


@dataclass(frozen=True)
class Scene:
    """A room or a yard: its things, and where a sensor goes in it."""

    name: str
    things: tuple[Thing, ...]
    inner: Box
    """The space between the faces of the walls."""

    half_walk_m: tuple[float, float]
    """Half the sides of the rectangle in which the sensor goes round, before the turn."""

    @property
    def thin(self) -> list[Thing]:
        """Everything but the walls."""
        return [thing for thing in self.things if thing.kind != WALL]

    def first_hits(self, origin_m: Array, rays: Array) -> tuple[Array, NDArray[np.int64]]:
        """The depth at which rays (N, 3) from a point meet something, inf for nothing, and which of the
        things that is, -1 for none; (N,) each."""
        depth_m, which = np.full(len(rays), np.inf), np.full(len(rays), -1)
        lengths = np.linalg.norm(rays, axis=1)
        for i, thing in enumerate(self.things):
            to = thing.shape.centre_m - origin_m
            tangent = to @ to - thing.shape.half_m @ thing.shape.half_m  # squared, to a ball around it
            near = np.arange(len(rays))
            if tangent > 0:
                near = np.flatnonzero(rays @ to >= math.sqrt(tangent) * lengths)
            there = thing.shape.depth(origin_m, rays[near])
            nearer = there < depth_m[near]
            depth_m[near[nearer]], which[near[nearer]] = there[nearer], i
        return depth_m, which

    def clearance(self, points_m: Array, things: Sequence[Thing] | None = None) -> Array:
        """Distance of points (N, 3) from the nearest thing, or the nearest of some, (N,)."""
        distance_m = np.full(len(points_m), np.inf)
        for thing in self.things if things is None else things:
            distance_m = np.minimum(distance_m, thing.shape.distance(points_m))
        return distance_m


@dataclass(frozen=True)
class Sensor:
    """A camera and its true noise: coefficients of sigma in ascending powers of depth."""

    camera: Camera
    sigma: tuple[float, ...]
    max_depth: float

    def sigma_at(self, depth_m: Array) -> Array:
        """Standard deviation in metres."""
        return sum((c * depth_m**i for i, c in enumerate(self.sigma)), np.zeros(depth_m.shape))


@dataclass(frozen=True)
class View:
    """A depth image, with the truth. Arrays are (H, W)."""

    T_world_camera: Array
    true_m: Array
    """Depth without noise, inf where nothing is in reach."""

    depth_m: NDArray[np.float32]
    """As measured, 0 where nothing is in reach."""

    thing: NDArray[np.int64]
    """Index of the thing that is seen, -1 for none."""

    def points(self, camera: Camera) -> Array:
        """Where the measured pixels' rays truly end, in the world, (N, 3)."""
        seen = self.depth_m > 0
        ends = camera.rays()[seen] * self.true_m[seen][:, None]
        return ends @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def depth_camera(sigma: tuple[float, ...], max_depth: float, width: int = 320) -> Sensor:
    """A Kinect, which has a width of 640 pixels, by default at half its resolution."""
    height, focal = width * 3 // 4, 525.0 / 640 * width
    return Sensor(
        PinholeCamera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)), sigma, max_depth
    )


def spinning_lidar(yard: bool) -> Sensor:
    """1024 columns and 16 rings, 30 degrees up and down, in a room; 32, 8 down to 4 up, in a yard."""
    rings = np.linspace(4, -8, 32) if yard else np.linspace(30, -30, 16)
    azimuths = np.linspace(math.pi, -math.pi, 1025)[:-1]
    return Sensor(SphericalCamera(np.radians(rings), azimuths), (0.02,), 60.0 if yard else 15.0)


def take_views(scene: Scene, sensor: Sensor, number: int, seed: int) -> list[View]:
    """Views from a walk round the scene: a camera looks at one thin thing after the other, a lidar around."""
    draw = np.random.default_rng(seed)
    rays = sensor.camera.rays()
    views = []
    for i in range(number):
        T = _pose(scene, sensor, i / number, i, draw)
        true_m, which = scene.first_hits(T[:3, 3], rays.reshape(-1, 3) @ T[:3, :3].T)
        true_m, which = true_m.reshape(rays.shape[:2]), which.reshape(rays.shape[:2])
        true_m[true_m > sensor.max_depth] = np.inf
        seen = np.isfinite(true_m)
        there_m = np.where(seen, true_m, 1.0)
        noisy_m = there_m + sensor.sigma_at(there_m) * draw.standard_normal(there_m.shape)
        depth_m = np.where(seen, np.maximum(noisy_m, 0), 0).astype(np.float32)
        views.append(View(T, true_m, depth_m, np.where(seen, which, -1)))
    return views


def _pose(scene: Scene, sensor: Sensor, share: float, index: int, draw: np.random.Generator) -> Array:
    """T_world_camera of a view, ``share`` of the path along two rounds."""
    turn, thin = _turn(), scene.thin
    while True:
        angle = 4 * math.pi * share + draw.normal(0, 0.3)
        out = draw.uniform(0.5, 1.0)
        at = [scene.half_walk_m[0] * out * math.cos(angle), scene.half_walk_m[1] * out * math.sin(angle)]
        position = turn @ [*at, draw.uniform(0.7, 1.7)] + SHIFT_M
        if scene.clearance(position[None])[0] < CLEAR_M:
            continue
        T = np.eye(4)
        T[:3, 3] = position
        if not isinstance(sensor.camera, PinholeCamera):
            yaw = draw.uniform(-math.pi, math.pi)
            T[:3, :3] = frame_along(np.array([0.0, 0, 1])) @ _turn(yaw)
            return T
        target = thin[(index * 7 + int(draw.integers(3))) % len(thin)].shape.centre_m
        look = target + draw.normal(0, 0.15, 3) - position
        if NEAR_M < np.linalg.norm(look) < FAR_M:
            z = look / np.linalg.norm(look)
            x = np.cross(z, [0, 0, 1])
            x /= np.linalg.norm(x)
            T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
            return T


def _turn(angle: float = TURN_RADIANS) -> Array:
    """Rotation about z, (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class Builder:
    """Collects things that are given in the room's own frame: its middle, on the floor."""

    def __init__(self) -> None:
        self.things: list[Thing] = []
        self.inner = Box(np.zeros(3), np.zeros(3), np.eye(3))
        self._turn = _turn()

    def box(self, kind: str, centre_m: Sequence[float], size_m: Sequence[float], yaw: float = 0.0) -> None:
        """An upright box, turned about the vertical."""
        frame = self._turn @ _turn(yaw)
        self.things.append(Thing(kind, Box(self._at(centre_m), 0.5 * np.array(size_m), frame)))

    def rod(
        self,
        kind: str,
        start_m: Sequence[float],
        end_m: Sequence[float],
        diameter_m: float,
        part_of: str = "",
    ) -> None:
        """A rod with round ends."""
        rod = Capsule(self._at(start_m), self._at(end_m), 0.5 * diameter_m)
        self.things.append(Thing(kind, rod, part_of))

    def disc(
        self, kind: str, centre_m: Sequence[float], normal: Array, radius_m: float, part_of: str = ""
    ) -> None:
        """A flat disc."""
        upright = self._turn @ (normal / np.linalg.norm(normal))
        self.things.append(Thing(kind, Disc(self._at(centre_m), upright, radius_m), part_of))

    def walls(self, length_m: float, width_m: float, height_m: float, ceiling: bool = True) -> None:
        """Floor, four walls and a ceiling, solid, around the given inner space."""
        w, beyond = WALL_M, 2 * WALL_M
        half = 0.5 * np.array([length_m, width_m, height_m])
        self.inner = Box(self._at((0, 0, half[2])), half, self._turn)
        for z in (-0.5 * w, height_m + 0.5 * w)[: 1 + ceiling]:
            self.box(WALL, (0, 0, z), (length_m + beyond, width_m + beyond, w))
        for side in (-0.5, 0.5):
            x, y = side * (length_m + w), side * (width_m + w)
            self.box(WALL, (x, 0, 0.5 * height_m), (w, width_m + beyond, height_m))
            self.box(WALL, (0, y, 0.5 * height_m), (length_m + beyond, w, height_m))

    def chair(self, x_m: float, y_m: float, yaw: float, slats: bool = False) -> None:
        """Four legs of 3 cm, a seat, and a back: a thin board, or slats."""
        turn = _turn(yaw)

        def at(right: float, ahead: float, up: float) -> list[float]:
            return list(turn @ [right, ahead, up] + [x_m, y_m, 0])

        for right in (-0.19, 0.19):
            for ahead in (-0.19, 0.19):
                self.rod("leg", at(right, ahead, 0.015), at(right, ahead, 0.43), 0.03)
        self.box("seat", at(0, 0, 0.46), (0.42, 0.42, 0.03), yaw)
        if not slats:
            self.box("back", at(0, -0.2, 0.7), (0.4, 0.02, 0.35), yaw)
            return
        for right in np.linspace(-0.18, 0.18, 5):
            self.box("slat", at(right, -0.2, 0.7), (0.025, 0.012, 0.45), yaw)
        self.box("slat", at(0, -0.2, 0.93), (0.42, 0.02, 0.03), yaw)

    def table(self, x_m: float, y_m: float, yaw: float, size_m: tuple[float, float], board_m: float) -> None:
        """A thin board on four legs of 4 cm."""
        self.box("table", (x_m, y_m, 0.74), (*size_m, board_m), yaw)
        for right in (-0.45, 0.45):
            for ahead in (-0.42, 0.42):
                foot = _turn(yaw) @ [right * size_m[0], ahead * size_m[1], 0] + [x_m, y_m, 0.02]
                self.rod("leg", list(foot), [foot[0], foot[1], 0.70], 0.04)

    def plant(self, x_m: float, y_m: float, leaves: int, draw: np.random.Generator) -> None:
        """A stem, and leaves of 6 to 12 cm in all orientations around it."""
        self.rod("stem", (x_m, y_m, 0.01), (x_m, y_m, 1.1), 0.02, "plant")
        for _ in range(leaves):
            off = draw.normal(size=3)
            off *= draw.uniform(0.12, 0.4) / np.linalg.norm(off)
            centre = (x_m + off[0], y_m + off[1], 0.9 + off[2])
            self.disc("leaf", centre, draw.normal(size=3), draw.uniform(0.03, 0.06), "plant")

    def fence(self, start_m: Array, end_m: Array, height_m: float, wire_m: float) -> None:
        """Upright wires every 5 cm between two rails of 3 cm and two posts of 4 cm."""
        length = float(np.linalg.norm(end_m - start_m))
        for height in (0.1, height_m):
            self.rod("rail", (*start_m, height), (*end_m, height), 0.03, "fence")
        for end in (start_m, end_m):
            self.rod("post 4 cm", (*end, 0.02), (*end, height_m), 0.04, "fence")
        for share in np.arange(0.05, length - 0.04, 0.05) / length:
            foot = start_m + share * (end_m - start_m)
            self.rod("wire", (*foot, 0.1), (*foot, height_m), wire_m, "fence")

    def _at(self, point_m: Sequence[float]) -> Array:
        return self._turn @ np.asarray(point_m, float) + SHIFT_M


def room(seed: int) -> Scene:
    """Three chairs, posts of 2, 4 and 6 cm, and two cables of 1 cm."""
    build = Builder()
    build.walls(5, 4, 2.5)
    for x, y, yaw in ((-1.3, 0.9, 0.4), (0.2, -1.1, 2.1), (1.5, 0.8, -1.0)):
        build.chair(x, y, yaw)
    for kind, diameter, places in (
        ("post 2 cm", 0.02, ((-0.4, 0.5), (1.2, -0.7))),
        ("post 4 cm", 0.04, ((0.5, 0.4), (-1.5, -0.6))),
        ("post 6 cm", 0.06, ((-0.6, -0.6), (0.9, 1.2))),
    ):
        for x, y in places:
            build.rod(kind, (x, y, 0.03), (x, y, 2.45), diameter)
    build.rod("cable", (-2.4, 0.1, 1.5), (2.4, 0.25, 1.7), 0.01)
    build.rod("cable", (-1.0, -1.9, 0.9), (-0.8, 1.9, 1.3), 0.01)
    return Scene("room", tuple(build.things), build.inner, (2.0, 1.5))


def fence(seed: int) -> Scene:
    """A fence of wires of 3 mm every 5 cm between two rails."""
    build = Builder()
    build.walls(5, 4, 2.5)
    build.fence(np.array([-1.4, 0.1]), np.array([1.3, -0.2]), 1.4, 0.003)
    return Scene("fence", tuple(build.things), build.inner, (2.0, 1.5))


def clutter(seed: int) -> Scene:
    """Two tables, two chairs with slats, and two plants."""
    build, draw = Builder(), np.random.default_rng(seed + 1000)
    build.walls(5, 4, 2.5)
    build.table(-1.2, 0.8, 0.3, (1.2, 0.7), 0.02)
    build.table(1.3, -0.9, -0.5, (0.9, 0.6), 0.03)
    build.chair(-0.8, -0.6, 0.9, slats=True)
    build.chair(0.4, 0.7, -2.0, slats=True)
    build.plant(1.7, 1.1, 60, draw)
    build.plant(-1.8, -1.2, 60, draw)
    return Scene("clutter", tuple(build.things), build.inner, (2.0, 1.5))


def yard(seed: int) -> Scene:
    """For a lidar: posts of 6 to 10 cm, a fence of wires, and wires between masts, at 5 to 30 m."""
    build, draw = Builder(), np.random.default_rng(seed + 2000)
    build.walls(60, 40, 4, ceiling=False)
    for kind, diameter in (("post 6 cm", 0.06), ("post 8 cm", 0.08), ("post 10 cm", 0.10)):
        for _ in range(6):
            x, y = draw.uniform(-24, 24), draw.choice([-1, 1]) * draw.uniform(6, 17)
            build.rod(kind, (x, y, 0.05), (x, y, 3.0), diameter)
    build.fence(np.array([-4.0, 6.0]), np.array([4.0, 6.5]), 1.6, 0.003)
    for height in (1.2, 2.0):
        build.rod("cable", (-15, -8, height), (15, -7, height + 0.5), 0.02)
    return Scene("yard", tuple(build.things), build.inner, (6.0, 3.0))


SCENES: dict[str, Callable[[int], Scene]] = {"room": room, "fence": fence, "clutter": clutter, "yard": yard}
