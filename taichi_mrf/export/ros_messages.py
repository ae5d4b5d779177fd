"""A map as messages of ROS 2's own types, as RViz, Nav2 and MoveIt take them; rosbags writes their bytes."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from taichi_mrf.datasets.timed_poses import quaternion
from taichi_mrf.export.map_server import LevelMap
from taichi_mrf.export.map_sink import (
    CLOUD,
    COSTMAP,
    OCTOMAP,
    PATH,
    SURFACE,
    TRANSFORMS,
    WORLD,
    Points,
    nanoseconds,
    occupancy_cells,
    plan_pose,
    point_records,
)
from taichi_mrf.export.octomap import binary_octree
from taichi_mrf.export.surface import Surface
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.libraries import library

TYPES = {
    CLOUD: "sensor_msgs/msg/PointCloud2",
    SURFACE: "visualization_msgs/msg/Marker",
    PATH: "nav_msgs/msg/Path",
    TRANSFORMS: "tf2_msgs/msg/TFMessage",
    COSTMAP: "nav_msgs/msg/OccupancyGrid",
    OCTOMAP: "octomap_msgs/msg/Octomap",
}
"""The type of each topic's messages."""

CAMERA = "taichi_mrf_camera"
"""Frame of the newest keyframe, which no robot has in its own tree."""

OCTOMAP_TEXT = "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"
"""The definition of octomap_msgs/msg/Octomap, which rosbags does not know."""

_UINT8, _FLOAT32 = 2, 7  # of sensor_msgs/PointField
_TRIANGLES = 11  # of visualization_msgs/Marker


class RosMessages:
    """A MapSink that makes messages: ``send`` gets the topic, the bytes (CDR), the stamp in nanoseconds."""

    def __init__(self, send: Callable[[str, bytes, int], None]) -> None:
        """Raises TaichiMRFError without the extra ``robot``."""
        typesys = library("rosbags.typesys", "messages of ROS need", "robot")
        self._store, self._send = typesys.get_typestore(typesys.Stores.LATEST), send
        self._store.register(typesys.get_types_from_msg(OCTOMAP_TEXT, TYPES[OCTOMAP]))

    def definition(self, topic: str) -> str:
        """The text that defines a topic's type."""
        return str(self._store.generate_msgdef(TYPES[topic], ros_version=2)[0])

    def type_hash(self, topic: str) -> str:
        """The hash of a topic's type, from ROS 2 Iron on."""
        return str(self._store.hash_rihs01(TYPES[topic]))

    def transform(self, T_world_camera: Pose, stamp_s: float) -> None:
        place, turn = self._placed(T_world_camera)
        moved = self._make("geometry_msgs/Transform", self._make("geometry_msgs/Vector3", *place), turn)
        stamped = self._make("geometry_msgs/TransformStamped", self._header(stamp_s), CAMERA, moved)
        self._write(TRANSFORMS, stamp_s, transforms=[stamped])

    def path(self, T_world_camera: Mapping[float, Pose]) -> None:
        poses = [
            self._make("geometry_msgs/PoseStamped", self._header(stamp_s), self._pose(T))
            for stamp_s, T in sorted(T_world_camera.items(), key=lambda each: each[0])
        ]
        newest_s = max(T_world_camera)
        self._write(PATH, newest_s, header=self._header(newest_s), poses=poses)

    def voxels(self, points: Points, stamp_s: float) -> None:
        """Send voxels as points; RViz shows the colours, if there are any, as the field rgb."""
        records = point_records(points)
        assert records.dtype.fields is not None
        offsets = {name: offset for name, (_, offset, *_) in records.dtype.fields.items()}
        if "blue" in offsets:
            offsets["rgb"] = offsets["blue"]
        fields = [
            self._make("sensor_msgs/PointField", name, offsets[name], _FLOAT32, 1)
            for name in (*"xyz", "probability", "size", "rgb")
            if name in offsets
        ]
        self._write(
            CLOUD, stamp_s, header=self._header(stamp_s), height=1, width=len(records), fields=fields,
            is_bigendian=False, point_step=records.itemsize, row_step=records.nbytes,
            data=np.frombuffer(records.tobytes(), np.uint8), is_dense=True,
        )  # fmt: skip

    def surface(self, surface: Surface, stamp_s: float) -> None:
        corners = surface.triangles.reshape(-1)
        points = [self._make("geometry_msgs/Point", *each) for each in surface.vertices_m.tolist()]
        rgb = (surface.colors / 255.0).tolist()
        colors = [self._make("std_msgs/ColorRGBA", *each, 1.0) for each in rgb]
        nothing = np.zeros(0, np.uint8)
        white = self._make("std_msgs/ColorRGBA", 1.0, 1.0, 1.0, 1.0)
        self._write(
            SURFACE, stamp_s, header=self._header(stamp_s), ns="surface", id=0, type=_TRIANGLES, action=0,
            pose=self._pose(np.eye(4)), scale=self._make("geometry_msgs/Vector3", 1.0, 1.0, 1.0), color=white,
            lifetime=self._make("builtin_interfaces/Duration", 0, 0), frame_locked=False,
            points=[points[i] for i in corners], colors=[colors[i] for i in corners], texture_resource="",
            texture=self._make("sensor_msgs/CompressedImage", self._header(0.0), "", nothing),
            uv_coordinates=[], text="", mesh_resource="",
            mesh_file=self._make("visualization_msgs/MeshFile", "", nothing),
            mesh_use_embedded_materials=False,
        )  # fmt: skip

    def costmap(self, level: LevelMap, height_m: float, stamp_s: float) -> None:
        cells, header = occupancy_cells(level), self._header(stamp_s)
        rows, columns = cells.shape
        info = self._make(
            "nav_msgs/MapMetaData", header.stamp, level.cell_size, columns, rows,
            self._pose(plan_pose(level, height_m)),
        )  # fmt: skip
        self._write(COSTMAP, stamp_s, header=header, info=info, data=cells.reshape(-1))

    def octomap(self, decided: VoxelMap, cells: bool, stamp_s: float) -> None:
        """Send which voxels are free and which occupied as a binary tree, as MoveIt takes it."""
        tree = np.frombuffer(binary_octree(decided, cells)[0], np.int8)
        self._write(
            OCTOMAP, stamp_s, header=self._header(stamp_s), binary=True, id="OcTree",
            resolution=decided.voxel_size, data=tree,
        )  # fmt: skip

    def _make(self, name: str, *parts: Any) -> Any:
        return self._store.types[name.replace("/", "/msg/")](*parts)

    def _placed(self, T: Pose) -> tuple[list[float], Any]:
        """A pose's place, and its turn as a message."""
        turn = self._make("geometry_msgs/Quaternion", *quaternion(T[:3, :3]).tolist())
        return T[:3, 3].tolist(), turn

    def _pose(self, T: Pose) -> Any:
        place, turn = self._placed(T)
        return self._make("geometry_msgs/Pose", self._make("geometry_msgs/Point", *place), turn)

    def _header(self, stamp_s: float) -> Any:
        stamp = self._make("builtin_interfaces/Time", *divmod(nanoseconds(stamp_s), 1_000_000_000))
        return self._make("std_msgs/Header", stamp, WORLD)

    def _write(self, topic: str, stamp_s: float, **fields: Any) -> None:
        name = TYPES[topic]
        message = self._store.types[name](**fields)
        self._send(topic, bytes(self._store.serialize_cdr(message, name)), nanoseconds(stamp_s))
