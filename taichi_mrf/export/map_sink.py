"""The messages of a map, whoever takes them: their topics, and what a file or a robot's wire has to take.

All are in the frame ``map``, the map's own world.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.export.map_server import LevelMap
from taichi_mrf.export.surface import Surface
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.queries.voxel_map import VoxelMap

WORLD, CAMERA = "map", "camera"
"""Frames of all messages."""

CLOUD, SURFACE, PATH, TRANSFORMS = "/map/voxels", "/map/surface", "/map/path", "/tf"
COSTMAP, OCTOMAP = "/map/costmap", "/map/octomap"

OCCUPIED_CELL, FREE_CELL, UNKNOWN_CELL = 100, 0, -1
"""Cells of a nav_msgs/OccupancyGrid."""


class Points(NamedTuple):
    """Voxels and cells: centres (n, 3), probabilities and sizes (n,), and colours (n, 3) if there are any."""

    centres_m: NDArray[np.float64]
    probability: NDArray[np.float32]
    sizes_m: NDArray[np.float64]
    colors: NDArray[np.uint8] | None


class MapSink(Protocol):
    """Receiver of a map's messages: the channels of a file, a server or a robot's wire."""

    def transform(self, T_world_camera: Pose, stamp_s: float) -> None:
        """Take the pose (4, 4) of a keyframe as that of the frame CAMERA."""

    def path(self, T_world_camera: Mapping[float, Pose]) -> None:
        """Take the poses (4, 4) of keyframes by their stamps in seconds as a path."""

    def voxels(self, points: Points, stamp_s: float) -> None:
        """Take voxels as points."""

    def surface(self, surface: Surface, stamp_s: float) -> None:
        """Take triangles; they take the place of those before."""

    def costmap(self, level: LevelMap, height_m: float, stamp_s: float) -> None:
        """Take a floor plan, which lies ``height_m`` along the axis up."""

    def octomap(self, decided: VoxelMap, cells: bool, stamp_s: float) -> None:
        """Take which voxels are free and which occupied."""


def point_records(points: Points) -> NDArray[Any]:
    """A record (n,) for each point, as clouds of messages have them: x, y, z, probability and size as
    float32, and with colours blue, green, red and alpha as uint8, the order of ROS's field rgb."""
    columns: list[tuple[str, NDArray[Any]]] = [
        *((name, column.astype("<f4")) for name, column in zip("xyz", points.centres_m.T, strict=True)),
        ("probability", points.probability.astype("<f4")),
        ("size", points.sizes_m.astype("<f4")),
    ]
    if points.colors is not None:
        columns += zip(("blue", "green", "red"), points.colors.T[::-1], strict=True)
        columns.append(("alpha", np.full(len(points.colors), 255, np.uint8)))
    records = np.zeros(len(points.centres_m), [(name, column.dtype) for name, column in columns])
    for name, column in columns:
        records[name] = column
    return records


def nanoseconds(stamp_s: float) -> int:
    """A stamp as messages have it; 0 for one before 1970."""
    return max(0, round(stamp_s * 1e9))


def occupancy_cells(level: LevelMap) -> NDArray[np.int8]:
    """The cells (rows, columns) of a nav_msgs/OccupancyGrid, rows from the lowest coordinate up."""
    cells = np.full(level.state.shape, UNKNOWN_CELL, np.int8)
    cells[level.state == FREE], cells[level.state == OCCUPIED] = FREE_CELL, OCCUPIED_CELL
    return cells


def plan_pose(level: LevelMap, height_m: float) -> Pose:
    """T_world_plan (4, 4) of a plan whose columns run along x and whose rows run along y."""
    T = np.eye(4)
    right, forwards = level.axes
    T[:3, :3] = 0.0
    T[right, 0] = T[forwards, 1] = 1.0
    T[:3, 2] = np.cross(T[:3, 0], T[:3, 1])
    T[[right, forwards], 3] = level.lower_corner_m
    T[3 - right - forwards, 3] = height_m
    return T
