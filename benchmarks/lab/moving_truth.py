"""The truth about a room in which something moves: who sees a thing's place, whose voxel is whose, and when.

Distances are exact (analytic solids). A voxel counts as a thing's if its centre lies in the thing or within
NEAR_M of it, and no wall or furniture is within CLEAR_M: noise spreads a surface over that much.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.analytic_render import render
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid, ball_radius, distance_to
from taichi_mrf.datasets.synthetic.room import SyntheticRoom, Thing, distance_to_solids, placed
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.simulate import KINECT_1, simulate
from taichi_mrf.voxels.layout import grid_keys

NEAR_M = 0.05
CLEAR_M = 0.10

SEEN_PIXELS = 25
"""A view sees a thing, or that it has gone, if the thing makes a difference to so many of its pixels."""

SWEEP_STEP_S = 0.1

WALL_VIEWS = 3
"""Of a wall, only what so many frames show counts."""

Points = NDArray[np.float64]
"""(N, 3) in metres, world frame."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Standing:
    """A thing in one place, from ``start_s`` to before ``end_s``."""

    thing: Thing
    solids: tuple[Solid, ...]
    start_s: float
    end_s: float

    @property
    def name(self) -> str:
        """The thing and its time, for reports."""
        return f"{self.thing.name} {self.start_s:g}-{self.end_s:g} s"


class MovingTruth:
    """Truth of a moving room (``synthetic:room?moving=...``) and of its frames, one a second."""

    def __init__(self, room: SyntheticRoom) -> None:
        """Raises ConfigError if nothing moves in the room, or its script repeats itself in the frames."""
        if room.moving_scene is None:
            raise ConfigError(f"{room.name}: nothing moves in this room; open it with moving=things")
        self.room, self.scene = room, room.moving_scene
        if room.stamp_at(len(room)) > self.scene.period_s:
            raise ConfigError(
                f"{room.name}: the truth is known for {self.scene.period_s:g} s, not for {len(room)} frames"
            )
        self.sees = cache(self._sees)
        self.clean_depth = cache(room.clean_depth)
        self.swept = cache(self._swept)

    @property
    def standings(self) -> list[Standing]:
        """Places of things, one after the other."""
        return [
            Standing(thing, placed(thing.solids, stay.begin), stay.start_s, stay.end_s)
            for thing in self.scene.things
            for stay in thing.stays
            if stay.stands
        ]

    def _sees(self, standing: Standing, index: int) -> bool:
        """True if a frame sees a standing thing; at another time, if it sees that the thing is not
        there."""
        stamp_s = self.room.stamp_at(index)
        others = [
            solid
            for thing in self.scene.things
            if thing is not standing.thing
            for solid in thing.solids_at(stamp_s)
        ]
        rest = (*self.scene.static.solids, *others)
        without, having = (
            render(Scene(solids, self.scene.static.light), self.room.camera, self.room.pose(index), False)[0]
            for solids in (rest, (*rest, *standing.solids))
        )
        return int((without != having).sum()) >= SEEN_PIXELS

    def belong(self, standing: Standing, centres: Points, stamp_s: float) -> Mask:
        """Which voxels (N, 3) are those of a standing thing's place, (N,). While the thing is elsewhere,
        those near anything that moves are left out."""
        mine = distance_to_solids(standing.solids, centres) <= NEAR_M
        near = centres[mine]
        clear = self.scene.static.signed_distance(near) > CLEAR_M
        if not standing.start_s <= stamp_s < standing.end_s:
            clear &= self.away_from_things(near, stamp_s)
        mine[mine] = clear
        return mine

    def _swept(self, voxel_size: float) -> "VoxelSet":
        """The voxels that walking things pass through, away from walls and furniture."""
        found = [np.zeros((0, 3), np.int32)]
        for stamp_s in np.arange(0.0, self.room.stamp_at(len(self.room)), SWEEP_STEP_S):
            for thing in self.scene.things:
                for solid in thing.solids_at(stamp_s) if thing.walks else ():
                    voxels = _voxels_around(solid, voxel_size)
                    within = distance_to(solid, _centres(voxels, voxel_size)) <= 0
                    found.append(voxels[within])
        voxels = np.concatenate(found)
        voxels = voxels[np.unique(grid_keys(voxels), return_index=True)[1]]
        clear = self.scene.static.signed_distance(_centres(voxels, voxel_size)) > CLEAR_M
        return VoxelSet(grid_keys(voxels[clear]), voxel_size)

    def frame_without_things(self, index: int) -> Frame:
        """A frame as it would be if all that moves were never there, with the same noise."""
        frame = self.room.read(index)
        camera = self.room.camera
        depth_m = render(self.scene.static, camera, frame.T_world_camera, color=False)[0]
        if self.room.options.noise == "kinect":
            depth_m = simulate(depth_m, camera, KINECT_1, seed=(self.room.options.seed, index))
        return replace(frame, depth_m=depth_m, color=None)

    def away_from_things(self, centres: Points, stamp_s: float) -> Mask:
        """Which points (N, 3) are further than NEAR_M from everything that moves, (N,), at a time."""
        return distance_to_solids(self.scene.solids_of_things(stamp_s), centres) > NEAR_M

    def newly_there(self, stamp_s: float, within_s: float = np.inf) -> tuple[Solid, ...]:
        """The solids of things that were not in their present place at the start, and came to it less than
        ``within_s`` ago; those of a thing on its way always."""
        found: list[Solid] = []
        for thing in self.scene.things:
            for stay in thing.stays:
                present = stay.start_s <= stamp_s < stay.end_s
                if present and (not stay.stands or (stay.start_s > 0 and stamp_s - stay.start_s < within_s)):
                    found += thing.solids_at(stamp_s)
        return tuple(found)

    def surface_points(self, index: int) -> Points:
        """The true points that the pixels of a frame show, (N, 3)."""
        depth_m, T = self.clean_depth(index), self.room.pose(index)
        points = (self.room.camera.rays() * depth_m[..., None].astype(np.float64))[depth_m > 0]
        return points @ T[:3, :3].T + T[:3, 3]

    def walls(self, centres: Points, voxel_size: float) -> Mask:
        """Which voxels (N, 3) hold a surface of what never moves that WALL_VIEWS frames or more show, (N,);
        none near a place of a thing that stands."""
        wall = np.abs(self.scene.static.signed_distance(centres)) <= 0.87 * voxel_size
        places = [solid for standing in self.standings for solid in standing.solids]
        wall[wall] = distance_to_solids(places, centres[wall]) > CLEAR_M
        wall[wall] = self._shown(centres[wall], 2 * voxel_size) >= WALL_VIEWS
        return wall

    def _shown(self, points: Points, tolerance_m: float) -> NDArray[np.int64]:
        """How many frames show what is at some points, (N,)."""
        camera, times = self.room.camera, np.zeros(len(points), np.int64)
        for index in range(len(self.room)):
            T, depth_m = self.room.pose(index), self.clean_depth(index)
            x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
            ahead = np.where(z > 0.1, z, np.inf)
            u = np.rint(camera.fx * x / ahead + camera.cx).astype(np.int64)
            v = np.rint(camera.fy * y / ahead + camera.cy).astype(np.int64)
            pictured = (z > 0.1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            times[pictured] += np.abs(depth_m[v[pictured], u[pictured]] - z[pictured]) <= tolerance_m
        return times


@dataclass(frozen=True)
class VoxelSet:
    """Some voxels of a grid: their keys (grid_keys), ascending."""

    keys: NDArray[np.int64]
    voxel_size: float

    def __len__(self) -> int:
        return len(self.keys)

    def has(self, centres: Points) -> Mask:
        """Which voxels (N, 3), by their centres in metres, are in the set, (N,)."""
        return np.isin(voxel_keys(centres, self.voxel_size), self.keys)


def voxel_keys(centres: Points, voxel_size: float) -> NDArray[np.int64]:
    """The keys of the voxels at some points, (N, 3) metres -> (N,)."""
    return grid_keys(np.floor(np.asarray(centres) / voxel_size))


def _centres(voxels: NDArray[np.int32], voxel_size: float) -> Points:
    return (voxels.astype(np.float64) + 0.5) * voxel_size


def _voxels_around(solid: Solid, voxel_size: float) -> NDArray[np.int32]:
    """All voxels of a box around a solid, (n, 3)."""
    center, radius = np.array(solid.center), ball_radius(solid)
    lower = np.floor((center - radius) / voxel_size).astype(np.int32)
    upper = np.floor((center + radius) / voxel_size).astype(np.int32)
    return (np.indices(tuple(upper - lower + 1)).reshape(3, -1).T + lower).astype(np.int32)
