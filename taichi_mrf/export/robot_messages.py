"""A map as the messages that robots and their viewers take, for an MCAP file and for a server.

Foxglove's own types, for viewers: occupied voxels as points, the measured surface as triangles, the poses of
keyframes. ROS 2's types, for planners: a costmap (nav_msgs/OccupancyGrid), as Nav2 takes it, and an octree
(octomap_msgs/Octomap), as MoveIt takes it. All are in the frame ``map``, the map's own world.
"""

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.timed_poses import quaternion
from taichi_mrf.export.map_server import LevelMap
from taichi_mrf.export.octomap import binary_octree
from taichi_mrf.export.surface import Surface
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.libraries import library

WORLD, CAMERA = "map", "camera"
"""Frames of all messages."""

CLOUD, SURFACE, PATH, TRANSFORMS = "/map/voxels", "/map/surface", "/map/path", "/tf"
COSTMAP, OCTOMAP = "/map/costmap", "/map/octomap"

OCCUPIED_CELL, FREE_CELL, UNKNOWN_CELL = 100, 0, -1
"""Cells of a nav_msgs/OccupancyGrid."""

OCTOMAP_TEXT = "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"
"""The definition of octomap_msgs/msg/Octomap, which rosbags does not know."""

_OCTOMAP_TYPE, _GRID_TYPE = "octomap_msgs/msg/Octomap", "nav_msgs/msg/OccupancyGrid"


def require_libraries(what: str) -> None:
    """Raise TaichiMRFError, which begins with ``what``, without the libraries that messages need."""
    library("foxglove", what, "robot")
    library("rosbags.typesys", what, "robot")


class Points(NamedTuple):
    """Voxels and cells: centres (n, 3), probabilities and sizes (n,), and colours (n, 3) if there are any."""

    centres_m: NDArray[np.float64]
    probability: NDArray[np.float32]
    sizes_m: NDArray[np.float64]
    colors: NDArray[np.uint8] | None


class MapSink(Protocol):
    """What takes the messages of a map: the channels of a file, a server or a robot's wire."""

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


class MapChannels:
    """Logs a map on channels of a Foxglove ``context``, whose sinks are files or a server."""

    def __init__(self, context: Any) -> None:
        """Raises TaichiMRFError without the libraries of the extra ``robot``."""
        self._foxglove = library("foxglove", "messages for robots need", "robot")
        self._messages = library("foxglove.messages", "messages for robots need", "robot")
        typed = library("foxglove.channels", "messages for robots need", "robot")
        self._context = context
        self._voxels = typed.PointCloudChannel(CLOUD, context=context)
        self._surface = typed.SceneUpdateChannel(SURFACE, context=context)
        self._path = typed.PosesInFrameChannel(PATH, context=context)
        self._transforms = typed.FrameTransformsChannel(TRANSFORMS, context=context)
        self._ros = _RosChannels(self._foxglove, context)
        typed_ones = self._voxels, self._surface, self._path, self._transforms
        self._all = {each.topic(): each for each in (*typed_ones, *self._ros.channels)}

    def are_wanted(self, topic: str) -> bool:
        """True if a file is written, or somebody has subscribed to the topic."""
        return bool(self._all[topic].has_sinks())

    def transform(self, T_world_camera: Pose, stamp_s: float) -> None:
        """Log the pose (4, 4) of a keyframe as that of the frame CAMERA."""
        place, turn = self._placed(T_world_camera)
        transform = self._messages.FrameTransform(
            timestamp=self._time(stamp_s), parent_frame_id=WORLD, child_frame_id=CAMERA,
            translation=place, rotation=turn,
        )  # fmt: skip
        message = self._messages.FrameTransforms(transforms=[transform])
        self._transforms.log(message, log_time=nanoseconds(stamp_s))

    def path(self, T_world_camera: Mapping[float, Pose]) -> None:
        """Log the poses (4, 4) of keyframes by their stamps in seconds as a path."""
        newest_s = max(T_world_camera)
        in_time = [T for _, T in sorted(T_world_camera.items(), key=lambda each: each[0])]
        placed = [self._placed(T) for T in in_time]
        poses = [self._messages.Pose(position=place, orientation=turn) for place, turn in placed]
        path = self._messages.PosesInFrame(timestamp=self._time(newest_s), frame_id=WORLD, poses=poses)
        self._path.log(path, log_time=nanoseconds(newest_s))

    def voxels(self, points: Points, stamp_s: float) -> None:
        """Log voxels as points."""
        columns: dict[str, NDArray[Any]] = {
            **dict(zip("xyz", points.centres_m.astype("<f4").T, strict=True)),
            "probability": points.probability.astype("<f4"),
            "size": points.sizes_m.astype("<f4"),
        }
        if points.colors is not None:
            names = ("red", "green", "blue")
            columns |= dict(zip(names, points.colors.T, strict=True)) | {
                "alpha": np.full(len(points.colors), 255, np.uint8)
            }
        records = np.zeros(len(points.centres_m), [(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            records[name] = column
        numeric = self._messages.PackedElementFieldNumericType
        kinds = {np.dtype("<f4"): numeric.Float32, np.dtype(np.uint8): numeric.Uint8}
        assert records.dtype.fields is not None
        fields = [
            self._messages.PackedElementField(name=name, offset=offset, type=kinds[dtype])
            for name, (dtype, offset, *_) in records.dtype.fields.items()
        ]
        cloud = self._messages.PointCloud(
            timestamp=self._time(stamp_s), frame_id=WORLD, pose=self._messages.Pose(),
            point_stride=records.dtype.itemsize, fields=fields, data=records.tobytes(),
        )  # fmt: skip
        self._voxels.log(cloud, log_time=nanoseconds(stamp_s))

    def surface(self, surface: Surface, stamp_s: float) -> None:
        """Log triangles; they take the place of those before."""
        make = self._messages
        triangles = make.TriangleListPrimitive(
            pose=make.Pose(),
            points=[make.Point3(x=x, y=y, z=z) for x, y, z in surface.vertices_m.tolist()],
            colors=[make.Color(r=r, g=g, b=b, a=1.0) for r, g, b in (surface.colors / 255.0).tolist()],
            indices=surface.triangles.reshape(-1).tolist(),
        )
        entity = make.SceneEntity(
            timestamp=self._time(stamp_s), frame_id=WORLD, id="surface", triangles=[triangles]
        )
        self._surface.log(make.SceneUpdate(entities=[entity]), log_time=nanoseconds(stamp_s))

    def costmap(self, level: LevelMap, height_m: float, stamp_s: float) -> None:
        """Log a floor plan as a nav_msgs/OccupancyGrid, which lies ``height_m`` along the axis up."""
        self._ros.costmap(occupancy_cells(level), level.cell_size, plan_pose(level, height_m), stamp_s)

    def octomap(self, decided: VoxelMap, cells: bool, stamp_s: float) -> None:
        """Log which voxels are free and which occupied as a binary octomap_msgs/Octomap."""
        self._ros.octomap(binary_octree(decided, cells)[0], decided.voxel_size, stamp_s)

    def _placed(self, T: Pose) -> tuple[Any, Any]:
        """A pose as a Vector3 and a Quaternion."""
        place = self._messages.Vector3(**dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
        turn = self._messages.Quaternion(**dict(zip("xyzw", quaternion(T[:3, :3]).tolist(), strict=True)))
        return place, turn

    def _time(self, stamp_s: float) -> Any:
        return self._messages.Timestamp(*divmod(nanoseconds(stamp_s), 1_000_000_000))


class _RosChannels:
    """Channels of ROS 2's types, whose messages rosbags writes."""

    def __init__(self, foxglove: Any, context: Any) -> None:
        typesys = library("rosbags.typesys", "messages of ROS need", "robot")
        self._store = typesys.get_typestore(typesys.Stores.LATEST)
        self._store.register(typesys.get_types_from_msg(OCTOMAP_TEXT, _OCTOMAP_TYPE))
        self._by_type: dict[str, Any] = {}
        for topic, name in ((COSTMAP, _GRID_TYPE), (OCTOMAP, _OCTOMAP_TYPE)):
            definition = self._store.generate_msgdef(name, ros_version=2)[0]
            schema = foxglove.Schema(name=name, encoding="ros2msg", data=definition.encode())
            self._by_type[name] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=context
            )
        self.channels = tuple(self._by_type.values())

    def costmap(self, cells: NDArray[np.int8], cell_size: float, T_world_plan: Pose, stamp_s: float) -> None:
        types = self._store.types
        (rows, columns), (x, y, z) = cells.shape, T_world_plan[:3, 3].tolist()
        turn = types["geometry_msgs/msg/Quaternion"](*quaternion(T_world_plan[:3, :3]).tolist())
        header = self._header(stamp_s)
        info = types["nav_msgs/msg/MapMetaData"](
            map_load_time=header.stamp, resolution=cell_size, width=columns, height=rows,
            origin=types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x, y, z), turn),
        )  # fmt: skip
        self._write(_GRID_TYPE, stamp_s, header=header, info=info, data=cells.reshape(-1))

    def octomap(self, tree: bytes, voxel_size: float, stamp_s: float) -> None:
        self._write(
            _OCTOMAP_TYPE, stamp_s, header=self._header(stamp_s), binary=True, id="OcTree",
            resolution=voxel_size, data=np.frombuffer(tree, np.int8),
        )  # fmt: skip

    def _header(self, stamp_s: float) -> Any:
        stamp = self._store.types["builtin_interfaces/msg/Time"](*divmod(nanoseconds(stamp_s), 1_000_000_000))
        return self._store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=WORLD)

    def _write(self, name: str, stamp_s: float, **fields: Any) -> None:
        message = self._store.types[name](**fields)
        content = bytes(self._store.serialize_cdr(message, name))
        self._by_type[name].log(content, log_time=nanoseconds(stamp_s))


def write_mcap(path: Path, log: Callable[[MapSink], None]) -> None:
    """Write what ``log`` logs to a file. Raises MapFileError, and TaichiMRFError without the extra
    ``robot``."""
    foxglove = library("foxglove", ".mcap files need", "robot")
    # In memory first: of a disk that is full the writer tells only that a write before has failed.
    context, content = foxglove.Context(), io.BytesIO()
    with foxglove.open_mcap(content, context=context):
        log(MapChannels(context))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.getbuffer())


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
