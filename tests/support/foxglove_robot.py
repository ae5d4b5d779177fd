"""A robot that runs: a server of Foxglove's own library that sends the messages of a bag."""

import base64
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import foxglove
from foxglove import messages as m
from heard import SECONDS, Sender
from rosbags.highlevel import AnyReader

from taichi_mrf.datasets.wires.client import wait_until


@dataclass
class Listener:
    """Counts who has subscribed to which topic."""

    topics: list[str] = field(default_factory=list)

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.topics.append(channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        self.topics.remove(channel.topic)

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments: None


@dataclass
class Robot(Sender):
    """In ``own``, protobuf or json, messages are Foxglove's own types in that encoding."""

    own: str = ""
    listener: Listener = field(default_factory=Listener)

    def __post_init__(self) -> None:
        self.context = foxglove.Context()
        self.channels: dict[str, Any] = {}
        with AnyReader([self.bag]) as reader:
            kind, encoding = ("ros2msg", "cdr") if reader.is2 else ("ros1msg", "ros1")
            for each in reader.connections:
                name = each.msgtype if reader.is2 else each.msgtype.replace("/msg/", "/")
                schema = foxglove.Schema(name=name, encoding=kind, data=each.msgdef.data.encode())
                if self.own:
                    schema = own_schema(each.msgtype, self.own)
                self.channels[each.topic] = foxglove.Channel(
                    each.topic, schema=schema, message_encoding=self.own or encoding, context=self.context
                )
            for each, time, data in reader.messages():
                if self.own:
                    data = own_message(reader.deserialize(data, each.msgtype), each.msgtype, self.own)
                self.messages.append((each.topic, time, bytes(data)))
        self.start()

    @property
    def source(self) -> str:
        return f"foxglove:ws://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Listen, at the same port as before once the system lets go of it."""
        assert wait_until(self._starts, SECONDS), f"port {self.port} is in use"

    def _starts(self) -> bool:
        try:
            self.server = foxglove.start_server(
                host="127.0.0.1", port=self.port, context=self.context, server_listener=self.listener
            )
        except RuntimeError:
            return False
        self.port = self.server.port
        return True

    def stop(self) -> None:
        self.server.stop()
        self.listener.topics.clear()

    def listened(self) -> set[str]:
        return set(self.listener.topics)

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        self.channels[topic].log(data, log_time=time_ns)

    def send(self, *topics: str) -> None:
        """Send all messages, or those of some topics."""
        for each in self.messages:
            if not topics or each[0] in topics:
                self.put(*each)

    def send_again(self, topic: str) -> None:
        """Send the first message of a topic as one of this moment."""
        self.channels[topic].log(next(data for name, _, data in self.messages if name == topic))


OWN = {
    "sensor_msgs/msg/Image": m.RawImage,
    "sensor_msgs/msg/CompressedImage": m.CompressedImage,
    "sensor_msgs/msg/CameraInfo": m.CameraCalibration,
    "tf2_msgs/msg/TFMessage": m.FrameTransforms,
    "sensor_msgs/msg/PointCloud2": m.PointCloud,
    "geometry_msgs/msg/PoseStamped": m.PoseInFrame,
}
"""Foxglove's own types in the place of those of ROS."""

NUMBERS = {
    1: (2, "Int8"), 2: (1, "Uint8"), 3: (4, "Int16"), 4: (3, "Uint16"),
    5: (6, "Int32"), 6: (5, "Uint32"), 7: (7, "Float32"), 8: (8, "Float64"),
}  # fmt: skip
"""PackedElementField's numbers of types and their names, by the numbers of PointField."""


def own_schema(msgtype: str, encoding: str) -> foxglove.Schema:
    schema = OWN[msgtype].get_schema()
    if encoding == "json":
        return foxglove.Schema(name=schema.name, encoding="jsonschema", data=b'{"type": "object"}')
    return schema


def own_message(message: Any, msgtype: str, encoding: str) -> bytes:
    """A message of ROS as Foxglove's library encodes its own, or by hand in JSON."""
    if encoding == "protobuf":
        return OWN[msgtype](**fields(message, msgtype, made)).encode()
    return json.dumps(fields(message, msgtype, lambda name, /, **parts: parts)).encode()


def made(name: str, /, **parts: Any) -> Any:
    """A part of a message in Foxglove's library."""
    if name == "Timestamp":
        return m.Timestamp(parts["sec"], parts["nsec"])
    if name == "PackedElementField":
        parts["type"] = getattr(m.PackedElementFieldNumericType, dict(NUMBERS.values())[parts["type"]])
    return getattr(m, name)(**parts)


def fields(message: Any, msgtype: str, make: Callable[..., Any]) -> dict[str, Any]:
    """The fields of Foxglove's message; ``make`` makes those that are messages themselves."""

    def axes(value: Any, names: str) -> dict[str, float]:
        return {name: float(getattr(value, name)) for name in names}

    def head(header: Any, frame: str = "frame_id") -> dict[str, Any]:
        time = make("Timestamp", sec=int(header.stamp.sec), nsec=int(header.stamp.nanosec))
        return {"timestamp": time, frame: header.frame_id}

    if msgtype == "tf2_msgs/msg/TFMessage":
        return {
            "transforms": [
                make(
                    "FrameTransform",
                    **head(each.header, "parent_frame_id"),
                    child_frame_id=each.child_frame_id,
                    translation=make("Vector3", **axes(each.transform.translation, "xyz")),
                    rotation=make("Quaternion", **axes(each.transform.rotation, "xyzw")),
                )
                for each in message.transforms
            ]
        }
    found = head(message.header)
    if msgtype == "geometry_msgs/msg/PoseStamped":
        place = make("Vector3", **axes(message.pose.position, "xyz"))
        turn = make("Quaternion", **axes(message.pose.orientation, "xyzw"))
        return found | {"pose": make("Pose", position=place, orientation=turn)}
    if msgtype == "sensor_msgs/msg/CameraInfo":
        arrays = {name.upper(): [float(v) for v in getattr(message, name)] for name in "dkrp"}
        sizes = {"width": message.width, "height": message.height}
        return found | arrays | sizes | {"distortion_model": message.distortion_model}
    data = bytes(message.data)
    if msgtype == "sensor_msgs/msg/PointCloud2":  # Foxglove's points have no rows
        rows = (data[i * message.row_step :] for i in range(message.height))
        data = b"".join(row[: message.width * message.point_step] for row in rows)
    found["data"] = base64.b64encode(data).decode() if make is not made else data
    if msgtype == "sensor_msgs/msg/CompressedImage":
        return found | {"format": message.format}
    if msgtype == "sensor_msgs/msg/PointCloud2":
        parts = [(each.name, int(each.offset), NUMBERS[int(each.datatype)][0]) for each in message.fields]
        packed = [make("PackedElementField", name=name, offset=at, type=kind) for name, at, kind in parts]
        return found | {"point_stride": message.point_step, "fields": packed}
    sizes = {name: getattr(message, name) for name in ("width", "height", "step", "encoding")}
    return found | sizes
