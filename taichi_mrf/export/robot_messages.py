"""A map as the messages that Foxglove takes, for an MCAP file and for a server.

Foxglove's own types, for viewers: occupied voxels as points, the measured surface as triangles, the poses of
keyframes. ROS 2's types, for planners: a costmap and an octree (ros_messages.py).
"""

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf.datasets.timed_poses import quaternion
from taichi_mrf.export.map_sink import (
    CAMERA,
    CLOUD,
    COSTMAP,
    OCTOMAP,
    PATH,
    SURFACE,
    TRANSFORMS,
    WORLD,
    MapSink,
    Points,
    nanoseconds,
    point_records,
)
from taichi_mrf.export.ros_messages import TYPES, RosMessages
from taichi_mrf.export.surface import Surface
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.libraries import library

_TYPED = {CLOUD: "PointCloud", SURFACE: "SceneUpdate", PATH: "PosesInFrame", TRANSFORMS: "FrameTransforms"}
"""Foxglove's own types by their topics."""


def require_libraries(what: str) -> None:
    """Raise TaichiMRFError, which begins with ``what``, without the libraries that messages need."""
    library("foxglove", what, "robot")
    library("rosbags.typesys", what, "robot")


class MapChannels:
    """A MapSink that logs on channels of a Foxglove ``context``, whose sinks are files or a server."""

    def __init__(self, context: Any) -> None:
        """Raises TaichiMRFError without the libraries of the extra ``robot``."""
        foxglove = library("foxglove", "messages for robots need", "robot")
        self._messages, self._context = foxglove.messages, context  # channels end with their context
        self._all = {
            topic: getattr(foxglove.channels, f"{name}Channel")(topic, context=context)
            for topic, name in _TYPED.items()
        }
        ros = RosMessages(self._log)
        for topic in (COSTMAP, OCTOMAP):
            schema = foxglove.Schema(
                name=TYPES[topic], encoding="ros2msg", data=ros.definition(topic).encode()
            )
            self._all[topic] = foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=context)
        self.costmap, self.octomap = ros.costmap, ros.octomap

    def are_wanted(self, topic: str) -> bool:
        """True if a file is written, or somebody has subscribed to the topic."""
        return bool(self._all[topic].has_sinks())

    def transform(self, T_world_camera: Pose, stamp_s: float) -> None:
        place, turn = self._placed(T_world_camera)
        transform = self._messages.FrameTransform(
            timestamp=self._time(stamp_s), parent_frame_id=WORLD, child_frame_id=CAMERA,
            translation=place, rotation=turn,
        )  # fmt: skip
        self._log(TRANSFORMS, self._messages.FrameTransforms(transforms=[transform]), nanoseconds(stamp_s))

    def path(self, T_world_camera: Mapping[float, Pose]) -> None:
        newest_s = max(T_world_camera)
        placed = [self._placed(T_world_camera[stamp_s]) for stamp_s in sorted(T_world_camera)]
        poses = [self._messages.Pose(position=place, orientation=turn) for place, turn in placed]
        path = self._messages.PosesInFrame(timestamp=self._time(newest_s), frame_id=WORLD, poses=poses)
        self._log(PATH, path, nanoseconds(newest_s))

    def voxels(self, points: Points, stamp_s: float) -> None:
        records = point_records(points)
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
        self._log(CLOUD, cloud, nanoseconds(stamp_s))

    def surface(self, surface: Surface, stamp_s: float) -> None:
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
        self._log(SURFACE, make.SceneUpdate(entities=[entity]), nanoseconds(stamp_s))

    def _log(self, topic: str, message: Any, time_ns: int) -> None:
        self._all[topic].log(message, log_time=time_ns)

    def _placed(self, T: Pose) -> tuple[Any, Any]:
        """A pose as a Vector3 and a Quaternion."""
        place = self._messages.Vector3(**dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
        turn = self._messages.Quaternion(**dict(zip("xyzw", quaternion(T[:3, :3]).tolist(), strict=True)))
        return place, turn

    def _time(self, stamp_s: float) -> Any:
        return self._messages.Timestamp(*divmod(nanoseconds(stamp_s), 1_000_000_000))


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
