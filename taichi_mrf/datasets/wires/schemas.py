"""Foxglove's own messages, of robots without ROS, as those of ROS that say the same.

Their fields are those of https://docs.foxglove.dev/docs/sdk/schemas, in protobuf or JSON. What is mapped is
then decided and decoded as for any robot: a RawImage is an Image, a FrameTransform one of a TFMessage.
"""

import base64
import json
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.sources import Channel
from taichi_mrf.datasets.wires import protobuf

PROTOBUF, JSON = "protobuf", "json"

ROS_TYPES = {
    "foxglove.RawImage": messages.IMAGE,
    "foxglove.CompressedImage": messages.IMAGES[1],
    "foxglove.CameraCalibration": messages.CAMERA_INFO,
    "foxglove.FrameTransform": messages.TF[0],
    "foxglove.FrameTransforms": messages.TF[0],
    "foxglove.PointCloud": messages.POINT_CLOUD,
    "foxglove.PoseInFrame": messages.POSE_STAMPED,
}

_NUMBERS = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""PointField's numbers of types, by those of PackedElementField."""


class SchemaDecoder:
    """Decodes the messages of a channel of one of ROS_TYPES."""

    def __init__(self, channel: Channel) -> None:
        """Raises errors of many kinds if the channel's descriptors are damaged."""
        self._name, self._is_json = channel.schema, channel.encoding == JSON
        self._types = {} if self._is_json else protobuf.types_of(base64.b64decode(channel.definition))
        if not self._is_json and self._name not in self._types:
            raise ValueError(f"its schema does not describe {self._name}")

    def decode(self, data: bytes) -> Any:
        """A message of ROS. Raises errors of many kinds for damaged data."""
        said = json.loads(data) if self._is_json else protobuf.decode(data, self._name, self._types)
        kind = ROS_TYPES[self._name]
        if kind == messages.TF[0]:
            return SimpleNamespace(transforms=[_transform(each) for each in said.get("transforms", [said])])
        if kind == messages.POSE_STAMPED:
            return SimpleNamespace(header=_header(said), pose=_pose(said.get("pose", {})))
        if kind == messages.CAMERA_INFO:
            return _camera(said)
        data_bytes = said.get("data", b"")
        data_bytes = base64.b64decode(data_bytes) if isinstance(data_bytes, str) else data_bytes
        pixels = np.frombuffer(data_bytes, np.uint8)
        if kind == messages.POINT_CLOUD:
            return _cloud(said, pixels)
        if kind == messages.IMAGE:
            sizes = {name: int(said.get(name, 0)) for name in ("width", "height", "step")}
            encoding = said.get("encoding", "")
            return SimpleNamespace(
                header=_header(said), encoding=encoding, is_bigendian=0, data=pixels, **sizes
            )
        return SimpleNamespace(header=_header(said), format=said.get("format", ""), data=pixels)


def _header(said: Mapping[str, Any], frame: str = "frame_id") -> SimpleNamespace:
    time = said.get("timestamp", {})
    sec, nanosec = (time.get("seconds", time.get("sec", 0)), time.get("nanos", time.get("nsec", 0)))
    stamp = SimpleNamespace(sec=int(sec), nanosec=int(nanosec))
    return SimpleNamespace(stamp=stamp, frame_id=said.get(frame, ""))


def _numbers(said: Mapping[str, Any], names: str) -> SimpleNamespace:
    return SimpleNamespace(**{name: float(said.get(name, 0.0)) for name in names})


def _pose(said: Mapping[str, Any]) -> SimpleNamespace:
    position, orientation = said.get("position", {}), said.get("orientation", {})
    return SimpleNamespace(position=_numbers(position, "xyz"), orientation=_numbers(orientation, "xyzw"))


def _transform(said: Mapping[str, Any]) -> SimpleNamespace:
    return SimpleNamespace(
        header=_header(said, "parent_frame_id"),
        child_frame_id=said.get("child_frame_id", ""),
        transform=SimpleNamespace(
            translation=_numbers(said.get("translation", {}), "xyz"),
            rotation=_numbers(said.get("rotation", {}), "xyzw"),
        ),
    )


def _camera(said: Mapping[str, Any]) -> SimpleNamespace:
    arrays = {"d": said.get("D", []), "k": said.get("K", [0.0] * 9), "p": said.get("P") or [0.0] * 12}
    return SimpleNamespace(
        header=_header(said),
        width=int(said.get("width", 0)),
        height=int(said.get("height", 0)),
        distortion_model=said.get("distortion_model", ""),
        roi=SimpleNamespace(width=0, height=0, x_offset=0, y_offset=0),
        binning_x=0,
        binning_y=0,
        **{name: np.array(values, np.float64) for name, values in arrays.items()},
    )


def _cloud(said: Mapping[str, Any], data: Any) -> SimpleNamespace:
    """A row of points. Raises ValueError if they have a pose of their own in their frame."""
    pose, step = _pose(said.get("pose", {})), int(said.get("point_stride", 0))
    turn = (pose.orientation.x, pose.orientation.y, pose.orientation.z)
    if any((pose.position.x, pose.position.y, pose.position.z, *turn)):
        raise ValueError("its points have a pose in their frame: send them in the sensor's own frame")
    fields = [
        SimpleNamespace(
            name=each.get("name", ""),
            offset=int(each.get("offset", 0)),
            datatype=_NUMBERS.get(int(each.get("type", 0)), 0),
        )
        for each in said.get("fields", [])
    ]
    width = len(data) // step if step else 0
    sizes = {"height": 1, "width": width, "point_step": step, "row_step": width * step, "is_bigendian": False}
    return SimpleNamespace(header=_header(said), fields=fields, data=data, **sizes)
