"""Foxglove's own messages, of robots without ROS, as those of ROS that say the same.

Their fields are those of https://docs.foxglove.dev/docs/sdk/schemas, in protobuf or JSON. What is mapped is
then decided and decoded as for any robot: a RawImage is an Image, a FrameTransform one of a TFMessage.
"""

import base64
import json
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.sources import Channel
from taichi_mrf.system.libraries import library

PROTOBUF, JSON = "protobuf", "json"

Said = Mapping[str, Any]
"""The fields of a message by their names; those that were not sent have their default."""

_NUMBERS = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""PointField's numbers of types, by those of PackedElementField."""


def decoder_of(channel: Channel) -> Callable[[bytes], Any]:
    """Decoder of a channel's bytes into ROS messages, of one of ROS_TYPES. It raises errors of many kinds for
    damaged data; so does this for damaged descriptors, and TaichiMRFError without protobuf's library."""
    made = _MADE[channel.schema][1]
    if channel.encoding == JSON:
        return lambda data: made(json.loads(data))
    said = protobuf_decoder(channel.schema, base64.b64decode(channel.definition))
    return lambda data: made(said(data))


def protobuf_decoder(name: str, descriptors: bytes) -> Callable[[bytes], dict[str, Any]]:
    """Decoder of a message's bytes into the fields that were sent; its type is ``name`` in a
    FileDescriptorSet. It raises errors of many kinds for damaged data; so does this for damaged descriptors,
    and ValueError if the type is not among them."""
    need = "messages in protobuf need", "ros"
    files = library("google.protobuf.descriptor_pb2", *need).FileDescriptorSet.FromString(descriptors).file
    types = library("google.protobuf.message_factory", *need).GetMessages(files)
    if name not in types:
        raise ValueError(f"its schema does not describe {name}")
    return lambda data: _sent(types[name].FromString(data))


def _sent(message: Any) -> dict[str, Any]:
    """The fields of a message of protobuf's library that were sent."""
    return {
        field.name: _plain(value) if field.message_type else value for field, value in message.ListFields()
    }


def _plain(value: Any) -> Any:
    """A field that is a message, or a list of them."""
    return _sent(value) if hasattr(value, "ListFields") else [_sent(each) for each in value]


def _header(said: Said, frame: str = "frame_id") -> SimpleNamespace:
    time = said.get("timestamp", {})
    sec, nanosec = (time.get("seconds", time.get("sec", 0)), time.get("nanos", time.get("nsec", 0)))
    stamp = SimpleNamespace(sec=int(sec), nanosec=int(nanosec))
    return SimpleNamespace(stamp=stamp, frame_id=said.get(frame, ""))


def _numbers(said: Said, names: str) -> SimpleNamespace:
    return SimpleNamespace(**{name: float(said.get(name, 0.0)) for name in names})


def _data(said: Said) -> Any:
    """The bytes (N,) uint8 of a message, which are base64 in JSON."""
    data = said.get("data", b"")
    return np.frombuffer(base64.b64decode(data) if isinstance(data, str) else data, np.uint8)


def _image(said: Said) -> SimpleNamespace:
    sizes = {name: int(said.get(name, 0)) for name in ("width", "height", "step")}
    encoding = said.get("encoding", "")
    return SimpleNamespace(header=_header(said), encoding=encoding, is_bigendian=0, data=_data(said), **sizes)


def _compressed(said: Said) -> SimpleNamespace:
    return SimpleNamespace(header=_header(said), format=said.get("format", ""), data=_data(said))


def _posed(said: Said) -> SimpleNamespace:
    return SimpleNamespace(header=_header(said), pose=_pose(said.get("pose", {})))


def _pose(said: Said) -> SimpleNamespace:
    position, orientation = said.get("position", {}), said.get("orientation", {})
    return SimpleNamespace(position=_numbers(position, "xyz"), orientation=_numbers(orientation, "xyzw"))


def _transforms(said: Said) -> SimpleNamespace:
    """Those of FrameTransforms, or the one that a FrameTransform is."""
    return SimpleNamespace(transforms=[_transform(each) for each in said.get("transforms", [said])])


def _transform(said: Said) -> SimpleNamespace:
    return SimpleNamespace(
        header=_header(said, "parent_frame_id"),
        child_frame_id=said.get("child_frame_id", ""),
        transform=SimpleNamespace(
            translation=_numbers(said.get("translation", {}), "xyz"),
            rotation=_numbers(said.get("rotation", {}), "xyzw"),
        ),
    )


def _camera(said: Said) -> SimpleNamespace:
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


def _cloud(said: Said) -> SimpleNamespace:
    """A row of points. Raises ValueError if they have a pose of their own in their frame."""
    pose, data, step = said.get("pose", {}), _data(said), int(said.get("point_stride", 0))
    if any(pose.get(part, {}).get(axis, 0.0) for part in ("position", "orientation") for axis in "xyz"):
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


_MADE: dict[str, tuple[str, Callable[[Said], Any]]] = {
    "foxglove.RawImage": (messages.IMAGE, _image),
    "foxglove.CompressedImage": (messages.IMAGES[1], _compressed),
    "foxglove.CameraCalibration": (messages.CAMERA_INFO, _camera),
    "foxglove.FrameTransform": (messages.TF[0], _transforms),
    "foxglove.FrameTransforms": (messages.TF[0], _transforms),
    "foxglove.PointCloud": (messages.POINT_CLOUD, _cloud),
    "foxglove.PoseInFrame": (messages.POSE_STAMPED, _posed),
}
"""The type of ROS that says the same, and what makes one of the fields."""

ROS_TYPES = {name: type for name, (type, _) in _MADE.items()}
