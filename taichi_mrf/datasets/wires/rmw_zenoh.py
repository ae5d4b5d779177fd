"""ROS 2 over Zenoh, as its middleware ``rmw_zenoh`` lays topics out: a client that listens, and a node that
publishes.

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
import uuid
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from taichi_mrf.datasets.ros.decoding import CDR
from taichi_mrf.datasets.ros.sources import Channel
from taichi_mrf.datasets.wires.client import Client, wait_until
from taichi_mrf.errors import ConfigError, DatasetError, TaichiMRFError, said
from taichi_mrf.system.libraries import library

PORT = 7447
ROUTER = "ros2 run rmw_zenoh_cpp rmw_zenohd"

CONNECT_S = 3.0
"""Seconds within which an address has to answer."""

FIND_S = 3.0
"""Seconds within which a publisher has to be found, and SETTLE_S more in which others may be."""

SETTLE_S = 0.3

HEARTBEAT_S = 0.5
"""Seconds after which a subscriber notices that it missed the last message of a topic."""

_TOKEN, _PUBLISHER, _SUBSCRIBER, _TRANSIENT_LOCAL = "@ros2_lv", "MP", "MS", "1"
_NODE = "%/%/taichi_mrf"
"""Enclave, namespace and name of the node that listens or publishes."""

_KEPT_QOS = f":{_TRANSIENT_LOCAL}:,1:,:,:,,"
"""Reliable, transient local, the last message: as ROS 2's own maps are published."""

_ATTACHED = struct.Struct("<qqB16s")


class Publisher(NamedTuple):
    """A publisher, by its liveliness token: its channel, whether it keeps messages for who comes later, and
    the end of the token: topic, type, hash and quality of service."""

    channel: Channel
    transient_local: bool
    described: str


class _Node:
    """A node of a robot's ROS 2. ``source`` names where it is."""

    def __init__(self, address: str, domain: int, problem: type[TaichiMRFError]) -> None:
        """Connect to ``tcp/host:port``, a router or a node, of which the protocol and the port may be
        missing; without an address to the router on this machine and to who answers by multicast.
        ``domain`` is the robot's ROS_DOMAIN_ID. Raises ``problem``, which names the address, if nobody
        answers there, and if Zenoh is not installed."""
        self.address, self._domain, self._declared = _whole(address), domain, 0
        self.source = f"zenoh:{self.address}" + (f"?domain={domain}" if domain else "")
        if domain < 0:
            raise problem(f"{self.source}: a domain is a number from 0 on")
        self._zenoh = library("zenoh", f"{self.source} needs", "robot", problem)
        self._ext = library("zenoh.ext", f"{self.source} needs", "robot", problem)
        self._session = self._opened(problem)

    def _opened(self, problem: type[TaichiMRFError]) -> Any:
        """A session. With an address it is a client, for whom a router sends on what all publish; without one
        a peer as the robot's own nodes are, which opens no port to the network."""
        address, is_peer = self.address or f"tcp/localhost:{PORT}", not self.address
        settings: dict[str, Any] = {
            "mode": "peer" if is_peer else "client",
            "connect/endpoints": [address],
            "connect/timeout_ms": 0 if is_peer else round(CONNECT_S * 1000),
            "connect/exit_on_failure": not is_peer,
            "scouting/multicast/enabled": is_peer,
            "timestamping/enabled": True,  # which kept messages need
            **({"listen/endpoints": ["tcp/localhost:0"]} if is_peer else {}),
        }
        config = self._zenoh.Config()
        try:
            for name, value in settings.items():
                config.insert_json5(name, json.dumps(value))
        except self._zenoh.ZError as error:
            raise problem(f"{self.source}: is not a Zenoh address: write tcp/HOST:{PORT}") from error
        try:
            return self._zenoh.open(config)
        except self._zenoh.ZError as error:
            why = said(error).partition(" at /")[0]  # without where in Zenoh's source
            raise problem(
                f"{self.source}: no answer within {CONNECT_S:g} s: is the robot on, in this network, its "
                f"port open? '{ROUTER}' starts its router, on port {PORT} (Zenoh: {why})"
            ) from error

    def _declare(self, entity: str, described: str = "") -> Any:
        """A liveliness token: first that of the node (NN), then of its publishers or subscribers of a topic,
        which is ``described`` by the end of the token."""
        numbers = str(self._domain), str(self._session.info.zid()), "0", str(self._declared)
        self._declared += 1
        token = "/".join([_TOKEN, *numbers, entity, _NODE, described]).rstrip("/")
        return self._session.liveliness().declare_token(token)

    def _watch(self, entity: str, take_in: Callable[[str, Publisher, bool], None]) -> None:
        """Call ``take_in`` with each token of an ``entity`` that comes or goes, what it says, and whether it
        has come; also with those that are there."""

        def take_in_token(sample: Any) -> None:
            token = str(sample.key_expr)
            found = publisher_of(token, entity)
            if found is not None:
                take_in(token, found, sample.kind == self._zenoh.SampleKind.PUT)

        every = f"{_TOKEN}/{self._domain}/**"
        self._session.liveliness().declare_subscriber(every, take_in_token, history=True)

    def close(self) -> None:
        """End the connection."""
        with suppress(self._zenoh.ZError):
            self._session.close()


class ZenohClient(_Node, Client):
    """Listens to the publishers of a domain. ``channels`` are those that were heard of."""

    def __init__(self, address: str, domain: int = 0) -> None:
        """Connect as a node does. Raises DatasetError, which names the address, if nobody answers there or
        nobody publishes, and if Zenoh is not installed."""
        _Node.__init__(self, address, domain, DatasetError)
        Client.__init__(self, self.address, self.source)
        self._publishers: dict[str, Publisher] = {}
        self._subscribed: dict[str, list[Any]] = {}
        try:
            self._watch(_PUBLISHER, self._take_in_token)
            if not wait_until(lambda: bool(self.channels), FIND_S):
                raise DatasetError(f"{self.source}: {self._nobody()}")
            self._node = self._declare("NN")
        except BaseException:
            self.close()
            raise
        time.sleep(SETTLE_S)

    def subscribe(self, topics: Collection[str]) -> None:
        """Ask for the messages of these topics and of no others; those that a transient local publisher keeps
        come, too, also if it comes later."""
        session, ext = self._session, self._ext
        for topic in set(self._subscribed) - set(topics):
            for each in self._subscribed.pop(topic):
                each.undeclare()
        with self._lock:
            publishers = {each.channel.topic: each for each in self._publishers.values()}
        for topic in sorted(set(topics) - set(self._subscribed)):
            publisher = publishers.get(topic)
            key = f"{self._domain}/{topic.strip('/')}/*/*"  # whatever its type, and the hash of that
            if publisher is not None and publisher.transient_local:
                subscriber = ext.declare_advanced_subscriber(
                    session,
                    key,
                    self._take_in,
                    history=ext.HistoryConfig(detect_late_publishers=True),
                    recovery=ext.RecoveryConfig(heartbeat=True),
                )
            else:
                subscriber = session.declare_subscriber(key, self._take_in)
            self._subscribed[topic] = [subscriber]
            if publisher is not None:  # nodes that publish only while somebody listens look for such a token
                self._subscribed[topic].append(self._declare(_SUBSCRIBER, publisher.described))

    def _nobody(self) -> str:
        """Reason why there are no topics."""
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

    def _take_in_token(self, token: str, publisher: Publisher, has_come: bool) -> None:
        with self._lock:
            if has_come:
                self._publishers[token] = publisher
            else:
                self._publishers.pop(token, None)
            self.channels = {each.channel.topic: each.channel for each in self._publishers.values()}
        self.problem = "" if self.channels else f"{self.source}: nobody is publishing any more; trying again"

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


class ZenohNode(_Node):
    """A node that publishes, and keeps each topic's last message for who comes later."""

    def __init__(
        self, address: str, domain: int, types: Mapping[str, tuple[str, str]], came: Callable[[str], None]
    ) -> None:
        """Connect as a node does, and publish on the topics of ``types``: name (nav_msgs/msg/Path) and hash
        of each one's type. ``came`` is told, from another thread, of each topic that somebody has subscribed
        to. Raises ConfigError, naming the address, if nobody answers, and without Zenoh."""
        super().__init__(address, domain, ConfigError)
        ext, self._came = self._ext, came
        self._listeners: dict[str, str] = {}
        self._sent, self._publishers = Counter[str](), dict[str, Any]()
        self._gids = {topic: uuid.uuid4().bytes for topic in types}
        self._tokens = [self._declare("NN")]
        for topic, (name, type_hash) in types.items():
            kind = _dds_type(name)
            self._publishers[topic] = ext.declare_advanced_publisher(
                self._session,
                f"{domain}/{topic.strip('/')}/{kind}/{type_hash}",
                cache=ext.CacheConfig(1),
                publisher_detection=True,
                sample_miss_detection=ext.MissDetectionConfig(sporadic_heartbeat=HEARTBEAT_S),
                congestion_control=self._zenoh.CongestionControl.BLOCK,  # a cloud is many packets
            )
            described = f"{topic.replace('/', '%')}/{kind}/{type_hash}/{_KEPT_QOS}"
            self._tokens.append(self._declare(_PUBLISHER, described))
        self._watch(_SUBSCRIBER, self._take_in_token)

    def send(self, topic: str, content: bytes) -> None:
        """Publish a message, in CDR with its encapsulation."""
        self._sent[topic] += 1
        attached = _ATTACHED.pack(self._sent[topic], time.time_ns(), 16, self._gids[topic])
        self._publishers[topic].put(content, attachment=attached)

    def are_wanted(self, topic: str) -> bool:
        """True if somebody has subscribed to the topic."""
        return topic in list(self._listeners.values())

    def _take_in_token(self, token: str, listener: Publisher, has_come: bool) -> None:
        topic = listener.channel.topic
        if not has_come:
            self._listeners.pop(token, None)
        elif topic in self._publishers:
            self._listeners[token] = topic
            self._came(topic)


def publisher_of(token: str, entity: str = _PUBLISHER) -> Publisher | None:
    """The publisher, or other ``entity``, that a liveliness token describes; None if it describes none."""
    parts = token.split("/")
    if len(parts) != 13 or parts[0] != _TOKEN or parts[5] != entity:
        return None
    topic, kind, _, qos = parts[9:]
    channel = Channel(topic.replace("%", "/"), _ros_type(kind), CDR)
    return Publisher(channel, qos.split(":")[1:2] == [_TRANSIENT_LOCAL], "/".join(parts[9:]))


def published_ns(attached: bytes) -> int | None:
    """Time when a message was published, in nanoseconds, from its attachment; None in another layout."""
    if len(attached) != _ATTACHED.size:
        return None
    _, stamp_ns, count, _ = _ATTACHED.unpack(attached)
    return stamp_ns if count == 16 else None


def _ros_type(kind: str) -> str:
    """A type's name as ROS 2 writes it: sensor_msgs::msg::dds_::Image_ is sensor_msgs/msg/Image."""
    package, *between, name = kind.split("::")
    return "/".join([package, *(each for each in between if each != "dds_"), name.removesuffix("_")])


def _dds_type(name: str) -> str:
    """The inverse of :func:`_ros_type`."""
    package, between, name = name.split("/")
    return f"{package}::{between}::dds_::{name}_"


def _whole(address: str) -> str:
    """An address with its protocol and port; empty without one."""
    if not address:
        return ""
    text = address if "/" in address else f"tcp/{address}"
    protocol, _, host = text.partition("/")
    has_port = ":" in host.rpartition("]")[2]
    return text if has_port else f"{protocol}/{host}:{PORT}"
