"""ROS 2 over Zenoh, as its middleware ``rmw_zenoh`` lays topics out: a client that only listens.

Publishers (MP) and subscribers (MS) declare liveliness tokens, whose parts are, with % for each / within one,
``@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/MP/ENCLAVE/NAMESPACE/NODE_NAME/TOPIC/TYPE/TYPE_HASH/QOS``. Messages have
the key ``DOMAIN/TOPIC/TYPE/TYPE_HASH``, where a type is written ``sensor_msgs::msg::dds_::Image_``. They are
CDR with its four bytes of encapsulation; attached are the number of the message and when it was published
(int64 each, in little endian, the time in nanoseconds), and the publisher's identifier, whose 16 bytes follow
their count. QOS is reliability:durability:...; durability 1 is transient local, and such a publisher keeps
its last messages for who comes later, as advanced publishers of Zenoh's extension do (docs/design.md, and
liveliness_utils.cpp and attachment_helpers.cpp in rmw_zenoh_cpp/src/detail, https://github.com/ros2/rmw_zenoh).

Definitions of messages are not sent: of a robot's own types nothing can be read. Zenoh's library receives, in
threads of its own, and makes a connection that is lost again.
"""

import json
import struct
import time
from collections.abc import Collection
from contextlib import suppress
from typing import Any, NamedTuple

from taichi_mrf.datasets.ros.decoding import CDR
from taichi_mrf.datasets.ros.sources import Channel
from taichi_mrf.datasets.wires.client import Client, wait_until
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.libraries import library

PORT = 7447
ROUTER = "ros2 run rmw_zenoh_cpp rmw_zenohd"

CONNECT_S = 3.0
"""Seconds within which an address has to answer."""

FIND_S = 3.0
"""Seconds within which a publisher has to be found, and SETTLE_S more in which others may be."""

SETTLE_S = 0.3

_TOKEN, _PUBLISHER, _TRANSIENT_LOCAL = "@ros2_lv", "MP", "1"
_NODE = "%/%/taichi_mrf"
"""Enclave, namespace and name of the node that listens."""

_ATTACHED = struct.Struct("<qqB16s")


class Publisher(NamedTuple):
    """A publisher, by its liveliness token: its channel, whether it keeps messages for who comes later, and
    the end of the token: topic, type, hash and quality of service."""

    channel: Channel
    transient_local: bool
    described: str


class ZenohClient(Client):
    """Listens to the publishers of a domain. ``channels`` are those that were heard of."""

    def __init__(self, address: str, domain: int = 0) -> None:
        """Connect to ``tcp/host:port``, a router or a node, of which the protocol and the port may be
        missing; without an address to the router on this machine and to who answers by multicast. ``domain``
        is the robot's ROS_DOMAIN_ID. Raises DatasetError, which names the address, if nobody answers there or
        nobody publishes, and if Zenoh is not installed."""
        whole = _whole(address)
        super().__init__(whole, f"zenoh:{whole}" + (f"?domain={domain}" if domain else ""))
        if domain < 0:
            raise DatasetError(f"{self.source}: a domain is a number from 0 on")
        self._domain, self._declared = domain, 0
        self._zenoh = library("zenoh", f"{self.source} needs", "robot", DatasetError)
        self._ext = library("zenoh.ext", f"{self.source} needs", "robot", DatasetError)
        self._publishers: dict[str, Publisher] = {}
        self._subscribed: dict[str, list[Any]] = {}
        self._session = self._opened()
        self._me = f"{_TOKEN}/{domain}/{self._session.info.zid()}/0"
        try:
            self._session.liveliness().declare_subscriber(
                f"{_TOKEN}/{domain}/**", self._take_in_token, history=True
            )
            if not wait_until(lambda: bool(self.channels), FIND_S):
                raise DatasetError(f"{self.source}: {self._nobody()}")
            self._node = self._session.liveliness().declare_token(f"{self._me}/0/NN/{_NODE}")
        except BaseException:
            self.close()
            raise
        time.sleep(SETTLE_S)

    def subscribe(self, topics: Collection[str]) -> None:
        """Ask for the messages of these topics and of no others; those that a transient local publisher keeps
        come, too, also if it comes later."""
        for topic in set(self._subscribed) - set(topics):
            for each in self._subscribed.pop(topic):
                each.undeclare()
        with self._lock:
            publishers = {each.channel.topic: each for each in self._publishers.values()}
        for topic in sorted(set(topics) - set(self._subscribed)):
            publisher = publishers.get(topic)
            key = f"{self._domain}/{topic.strip('/')}/*/*"  # whatever its type, and the hash of that
            if publisher is not None and publisher.transient_local:
                subscriber = self._ext.declare_advanced_subscriber(
                    self._session,
                    key,
                    self._take_in,
                    history=self._ext.HistoryConfig(detect_late_publishers=True),
                    recovery=self._ext.RecoveryConfig(heartbeat=True),
                )
            else:
                subscriber = self._session.declare_subscriber(key, self._take_in)
            self._subscribed[topic] = [subscriber]
            if publisher is not None:  # nodes that publish only while somebody listens look for such a token
                self._declared += 1
                token = f"{self._me}/{self._declared}/MS/{_NODE}/{publisher.described}"
                self._subscribed[topic].append(self._session.liveliness().declare_token(token))

    def close(self) -> None:
        """End the connection."""
        with suppress(self._zenoh.ZError):
            self._session.close()

    def _opened(self) -> Any:
        """The session. With an address it is a client, to whom a router sends on what all publish; without
        one a peer as the robot's own nodes are, which opens no port to the network."""
        settings: dict[str, Any] = {
            "mode": "client",
            "connect/endpoints": [self.address],
            "connect/timeout_ms": round(CONNECT_S * 1000),
            "connect/exit_on_failure": True,
            "scouting/multicast/enabled": False,
        }
        if not self.address:
            settings = {
                "mode": "peer",
                "connect/endpoints": [f"tcp/localhost:{PORT}"],
                "connect/timeout_ms": 0,
                "connect/exit_on_failure": False,
                "listen/endpoints": ["tcp/localhost:0"],
                "scouting/multicast/enabled": True,
            }
        config = self._zenoh.Config()
        try:
            for name, value in settings.items():
                config.insert_json5(name, json.dumps(value))
        except self._zenoh.ZError as error:
            raise DatasetError(
                f"{self.source}: is no address of Zenoh's: it is written tcp/HOST:{PORT}"
            ) from error
        try:
            return self._zenoh.open(config)
        except self._zenoh.ZError as error:
            raise DatasetError(
                f"{self.source}: no answer within {CONNECT_S:g} s: is the robot on, in this network, its "
                f"port open? '{ROUTER}' starts its router, on port {PORT} (Zenoh: {_first(error)})"
            ) from error

    def _nobody(self) -> str:
        """Why there are no topics."""
        info = self._session.info
        if not (self.address or info.routers_zid() or info.peers_zid()):
            return (
                f"nobody answers within {FIND_S:g} s: '{ROUTER}' starts a router on this machine, and "
                f"zenoh:tcp/HOST:{PORT} names one on another"
            )
        replies = self._session.liveliness().get(f"{_TOKEN}/**", timeout=FIND_S)
        others = {str(each.ok.key_expr).split("/")[1] for each in replies if each.ok}
        hint = " and ".join(f"?domain={each}" for each in sorted(others))
        return (
            f"connected, but no ROS 2 node publishes in domain {self._domain}: "
            + (f"nodes are in {hint}" if hint else "?domain=N is the robot's ROS_DOMAIN_ID")
            + ", and its nodes run with RMW_IMPLEMENTATION=rmw_zenoh_cpp" * (not hint)
        )

    def _take_in_token(self, sample: Any) -> None:
        token = str(sample.key_expr)
        publisher = publisher_of(token)
        if publisher is None:
            return
        with self._lock:
            if sample.kind == self._zenoh.SampleKind.PUT:
                self._publishers[token] = publisher
            else:
                self._publishers.pop(token, None)
            self.channels = {each.channel.topic: each.channel for each in self._publishers.values()}
        self.problem = "" if self.channels else f"{self.source}: nobody publishes any more; trying again"

    def _take_in(self, sample: Any) -> None:
        if sample.kind != self._zenoh.SampleKind.PUT:
            return
        _, *topic, kind, _ = str(sample.key_expr).split("/")
        attached = b"" if sample.attachment is None else sample.attachment.to_bytes()
        logged_ns = published_ns(attached)
        with self._lock:
            channel = self.channels.get("/" + "/".join(topic))
            if channel is not None and channel.type == _ros_type(kind):
                self._keep(
                    channel, time.time_ns() if logged_ns is None else logged_ns, sample.payload.to_bytes()
                )


def publisher_of(token: str) -> Publisher | None:
    """What a liveliness token says of a publisher, None if it is another entity's, or none."""
    parts = token.split("/")
    if len(parts) != 13 or parts[0] != _TOKEN or parts[5] != _PUBLISHER:
        return None
    topic, kind, _, qos = parts[9:]
    channel = Channel(topic.replace("%", "/"), _ros_type(kind), CDR)
    return Publisher(channel, qos.split(":")[1:2] == [_TRANSIENT_LOCAL], "/".join(parts[9:]))


def published_ns(attached: bytes) -> int | None:
    """When a message was published, in nanoseconds, by what is attached to it; None if that has another
    layout."""
    if len(attached) != _ATTACHED.size:
        return None
    _, stamp_ns, count, _ = _ATTACHED.unpack(attached)
    return stamp_ns if count == 16 else None


def _ros_type(kind: str) -> str:
    """A type's name as ROS 2 writes it: sensor_msgs::msg::dds_::Image_ is sensor_msgs/msg/Image."""
    package, *between, name = kind.split("::")
    return "/".join([package, *(each for each in between if each != "dds_"), name.removesuffix("_")])


def _first(error: Exception) -> str:
    """What an error of Zenoh's says, without where in its source."""
    return said(error).partition(" at /")[0]


def _whole(address: str) -> str:
    """An address with its protocol and port; empty without one."""
    if not address:
        return ""
    text = address if "/" in address else f"tcp/{address}"
    protocol, _, host = text.partition("/")
    has_port = ":" in host.rpartition("]")[2]
    return text if has_port else f"{protocol}/{host}:{PORT}"
