"""A robot that runs ROS 2 over Zenoh: a session that declares and publishes as rmw_zenoh's nodes do.

The session, its tokens, keys, attachments and its cache for late subscribers are laid out by hand, by
rmw_zenoh's docs and sources, so that the client under test reads nothing that it wrote itself.
"""

import json
import socket
import struct
from dataclasses import dataclass, field
from typing import Any

import zenoh
from heard import Sender
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from zenoh import ext

GID = bytes(range(16))


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def config(**settings: Any) -> zenoh.Config:
    """A configuration; in names, __ stands for /."""
    found = zenoh.Config()
    for name, value in settings.items():
        found.insert_json5(name.replace("__", "/"), json.dumps(value))
    return found


def dds_name(msgtype: str) -> str:
    """sensor_msgs/msg/Image as sensor_msgs::msg::dds_::Image_."""
    package, _, name = msgtype.split("/")
    return f"{package}::msg::dds_::{name}_"


def attached(number: int, time_ns: int) -> bytes:
    """What is attached to a message: number, time, and an identifier after its length."""
    return struct.pack("<qq", number, time_ns) + bytes([len(GID)]) + GID


@dataclass
class Robot(Sender):
    """Who publishes on a topic of ``transient`` keeps its last message. ``mode`` is router or peer, or node:
    a peer behind a router of its own, as rmw_zenoh's are."""

    domain: int = 0
    mode: str = "router"
    transient: tuple[str, ...] = ("/tf_static",)
    scouting: bool = False
    foreign: tuple[str, ...] = ()
    """Topics of a type that only the robot knows."""
    types: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.port = self.port or free_port()
        with AnyReader([self.bag]) as reader:
            self.types = {each.topic: each.msgtype for each in reader.connections}
            self.messages = [(each.topic, time, bytes(data)) for each, time, data in reader.messages()]
        self.types |= dict.fromkeys(self.foreign, "robot_msgs/msg/Own")
        self.start()

    @property
    def source(self) -> str:
        return f"zenoh:tcp/127.0.0.1:{self.port}"

    def key(self, topic: str) -> str:
        return f"{self.domain}{topic}/{dds_name(self.types[topic])}/{self.type_hash(topic)}"

    def type_hash(self, topic: str) -> str:
        store, msgtype = get_typestore(Stores.ROS2_HUMBLE), self.types[topic]
        return "RIHS01_" + "0" * 64 if topic in self.foreign else store.hash_rihs01(msgtype)

    def token(self, topic: str, number: int, kind: str = "MP") -> str:
        qos = ":1:,1:,:,:,," if topic in self.transient else "::,:,:,:,,"
        parts = ["@ros2_lv", str(self.domain), str(self.session.info.zid()), "0", str(number), kind]
        parts += ["%", "%arm", "camera_node", topic.replace("/", "%")]
        return "/".join([*parts, dds_name(self.types[topic]), self.type_hash(topic), qos])

    def start(self) -> None:
        """Open the session, at the same port as before."""
        own: dict[str, Any] = {"mode": self.mode, "listen__endpoints": [f"tcp/127.0.0.1:{self.port}"]}
        off: dict[str, Any] = {"scouting__multicast__enabled": self.scouting}
        self.router = None
        if self.mode == "node":
            self.router = zenoh.open(config(**own | off | {"mode": "router"}))
            own = {"mode": "peer", "listen__endpoints": ["tcp/localhost:0"]}
            own["connect__endpoints"] = [f"tcp/127.0.0.1:{self.port}"]
        self.session = zenoh.open(config(**own, **off, timestamping__enabled=True))
        self.publishers: dict[str, Any] = {}
        self.listeners: set[str] = set()
        self.numbers = dict.fromkeys(self.types, 0)
        self.tokens = []
        for number, topic in enumerate(self.types):
            self.publishers[topic] = self._publisher(topic)
            self.tokens.append(self.session.liveliness().declare_token(self.token(topic, 10 + number)))
        node = f"@ros2_lv/{self.domain}/{self.session.info.zid()}/0/0/NN/%/%arm/camera_node"
        self.tokens.append(self.session.liveliness().declare_token(node))

        self.session.liveliness().declare_subscriber(f"@ros2_lv/{self.domain}/**", self._saw, history=True)

    def _saw(self, sample: zenoh.Sample) -> None:
        """Note the tokens of subscribers, as a publisher that only publishes while somebody listens."""
        token = str(sample.key_expr)
        if token.split("/")[5] == "MS":
            note = self.listeners.add if sample.kind == zenoh.SampleKind.PUT else self.listeners.discard
            note(token)

    def _publisher(self, topic: str) -> Any:
        if topic not in self.transient:
            return self.session.declare_publisher(self.key(topic))
        return ext.declare_advanced_publisher(
            self.session,
            self.key(topic),
            cache=ext.CacheConfig(1),
            publisher_detection=True,
            sample_miss_detection=ext.MissDetectionConfig(sporadic_heartbeat=0.5),
        )

    def stop(self) -> None:
        self.session.close()
        if self.router is not None:
            self.router.close()

    def listened(self) -> set[str]:
        return {token.split("/")[9].replace("%", "/") for token in list(self.listeners)}

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        self.numbers[topic] += 1
        self.publishers[topic].put(data, attachment=attached(self.numbers[topic], time_ns))
