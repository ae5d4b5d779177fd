"""Serves a map's messages (export.map_sink) to Foxglove and to robots while it is made: those that have
changed, to those who have subscribed.

What maps asks between two frames whether a message is due. A message costs nothing while nobody has
subscribed to it or the map is the one that it was last made of, and at most a tenth of the time while frames
come.
"""

import math
import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any

from taichi_mrf.config.arguments import ArgumentTypeError, shown
from taichi_mrf.datasets.wires.rmw_zenoh import ZenohNode
from taichi_mrf.errors import ConfigError, said
from taichi_mrf.export.formats import MESSAGES, MapToSend
from taichi_mrf.export.map_sink import SURFACE, TRANSFORMS
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.export.robot_messages import MapChannels
from taichi_mrf.export.ros_messages import TYPES, RosMessages
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.system.libraries import library

PORT = 8765
"""Port at which Foxglove looks for a server."""

EVERY_S = 1.0
"""Shortest time between two messages of a topic, in seconds."""

SHARE = 0.1
"""Messages take at most this share of the time while frames come."""

LINGER_S = 1.0
"""Time that subscribers have for the last messages before the server ends, in seconds."""

TOPICS = (TRANSFORMS, *MESSAGES)


@dataclass
class _Sent:
    """The last message of a topic: when it was begun, and the map that it was made of."""

    begun_s: float = -math.inf
    state: Hashable = None


class MessageServer:
    """Sends a map's messages to those who subscribe. ``address`` is where it listens."""

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int = PORT,
        zenoh: str | None = None,
        domain: int = 0,
        every_s: float = EVERY_S,
        options: ExportOptions | None = None,
    ) -> None:
        """Listen for Foxglove; ``port`` 0 takes any. Or publish over ``zenoh``, to who is at this address
        (``tcp/host:port``; empty: on this machine), in the ROS_DOMAIN_ID ``domain``. ``options`` are those of
        the messages in a file, with a costmap if they have a band of heights. Raises TaichiMRFError without
        the extra ``robot``, and ConfigError if nobody can listen or be reached there."""
        self._options, self._every_s = options or ExportOptions(), every_s
        self._sent = {topic: _Sent() for topic in TOPICS}
        self._ended_s, self._took_s = -math.inf, 0.0  # the last message of all
        wire = _Foxglove(self._came, host, port) if zenoh is None else _Zenoh(self._came, zenoh, domain)
        self._wire, self._channels, self.address = wire, wire.channels, wire.address

    def due_in(self, m: OccupancyMap, at_rest: bool) -> float | None:
        """Seconds until a message is due, 0 if one is; None if nobody waits for any."""
        return min((wait for wait, _ in self._waits(m, at_rest)), default=None)

    def send(self, m: OccupancyMap, at_rest: bool, poses: Mapping[float, Pose]) -> bool:
        """Send one message if one is due, with the ``poses`` of keyframes by their stamps in seconds; returns
        whether there was one. The surface is sent once the map is ``at_rest``. Raises TaichiMRFError if the
        message cannot be made; it is not tried again before the map has changed."""
        due = [(self._sent[topic].begun_s, topic) for wait, topic in self._waits(m, at_rest) if wait <= 0]
        if not due:
            return False
        topic, begun_s = min(due, key=lambda each: each[0])[1], time.monotonic()
        # Noted first: who subscribes meanwhile is sent another one.
        self._sent[topic] = _Sent(begun_s, _state(m, at_rest))
        try:
            self._log(topic, m, at_rest, poses)
        finally:
            self._ended_s = time.monotonic()
            self._took_s = self._ended_s - begun_s
        return True

    def _log(self, topic: str, m: OccupancyMap, at_rest: bool, poses: Mapping[float, Pose]) -> None:
        if topic == TRANSFORMS:
            newest_s = max(poses, default=None)
            if newest_s is not None:
                self._channels.transform(poses[newest_s], newest_s)
        else:
            MESSAGES[topic](self._channels, MapToSend(m, self._options, poses))

    def start_over(self) -> None:
        """Send everything again: the map is another one."""
        for sent in self._sent.values():
            sent.state = None

    def close(self) -> None:
        """End, once those who have subscribed have had time to receive the last messages."""
        if any(map(self._wire.are_wanted, TOPICS)):
            time.sleep(max(0.0, self._ended_s + LINGER_S - time.monotonic()))
        self._wire.stop()

    def _waits(self, m: OccupancyMap, at_rest: bool) -> list[tuple[float, str]]:
        """Seconds until a topic's message may be sent, for each topic that lacks one."""
        if not len(m.view.pool.in_use):
            return []
        state, now_s, found = _state(m, at_rest), time.monotonic(), []
        free_s = self._ended_s + (0.0 if at_rest else self._took_s * (1 / SHARE - 1))
        for topic, sent in self._sent.items():
            owed = sent.state != state and (at_rest or topic != SURFACE)
            if owed and self._wire.are_wanted(topic):
                found.append((max(0.0, free_s - now_s, sent.begun_s + self._every_s - now_s), topic))
        return found

    def _came(self, topic: str) -> None:
        """Somebody has subscribed to a topic; called from the server's thread."""
        self._sent[topic].state = None


class Published:
    """A map of the caller's own program whose messages are served; use it as a context, or :meth:`close` it.
    ``address`` is where Foxglove connects."""

    def __init__(self, m: OccupancyMap, options: ExportOptions | None, **where: Any) -> None:
        """See :func:`publish`."""
        if not hasattr(m, "marginals") or not hasattr(m, "add_keyframe"):
            raise ArgumentTypeError(f"m must be a map that takes keyframes, such as MRFMap, not {shown(m)}")
        self._m, self._server = m, MessageServer(options=options, **where)
        self.address, self._revision = self._server.address, -1

    def update(self) -> None:
        """Send what is due. Call it after each keyframe, or every few, and now and then while the map rests:
        if it has settled or has not changed since the last call, what is occupied and the measured surface
        are sent. Costs nothing without a subscriber. Raises TaichiMRFError if a message cannot be made."""
        m = self._m
        revision = m.view.pool.revision
        at_rest = m.settled or revision == self._revision
        self._revision = revision
        poses = {k.stamp_s: k.T_world_camera for k in m.keyframes.values()}
        while self._server.send(m, at_rest, poses):
            pass

    def close(self) -> None:
        """End the server; the map stays."""
        self._server.close()

    def __enter__(self) -> "Published":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


def publish(m: OccupancyMap, options: ExportOptions | None = None, **where: Any) -> Published:
    """Serve a map to Foxglove or to a robot while the caller's own loop makes it.

    ``options`` are those of :func:`export_map`; a band of heights, ``ExportOptions(z_min=0.1, z_max=1.5)``,
    adds a costmap. ``where``: ``port`` (8765, 0 for any) and ``host`` (127.0.0.1) for Foxglove, or ``zenoh``,
    the address of a robot's router (``tcp/robot:7447``, ``""`` on this machine), with its ``domain``, for
    ROS 2's nodes; ``every_s``, the shortest time between two messages of a topic (1 s). Raises
    ArgumentTypeError if ``m`` takes no keyframes, ConfigError if the port is taken or nobody answers, and
    TaichiMRFError without the extra ``robot``. Example::

        with tm.publish(m, port=8765) as served:
            for depth_m, T_world_camera in camera:
                m.renew([m.add_keyframe(depth_m, T_world_camera, intrinsics)])
                served.update()
    """
    return Published(m, options, **where)


def _state(m: OccupancyMap, at_rest: bool) -> Hashable:
    return m.view.pool.revision, m.settled, len(m.keyframes), at_rest


class _Foxglove:
    """Foxglove's own server."""

    def __init__(self, came: Callable[[str], None], host: str, port: int) -> None:
        foxglove = library("foxglove", "messages for robots need", "robot")
        context = foxglove.Context()
        self.channels = MapChannels(context)
        self.are_wanted = self.channels.are_wanted
        try:
            server = foxglove.start_server(
                name="taichi-mrf", context=context, host=host, port=port, server_listener=_Listener(came)
            )
        except (OverflowError, RuntimeError, ValueError) as error:
            raise ConfigError(
                f"no messages can be served at {host}:{port} ({said(error)}): name another port or host"
            ) from error
        self.stop, self.address = server.stop, f"ws://{f'[{host}]' if ':' in host else host}:{server.port}"


class _Zenoh:
    """A node of ROS 2 over Zenoh."""

    def __init__(self, came: Callable[[str], None], address: str, domain: int) -> None:
        messages = RosMessages(lambda topic, content, _: node.send(topic, content))
        types = {topic: (name, messages.type_hash(topic)) for topic, name in TYPES.items()}
        node = ZenohNode(address, domain, types, came)
        self.channels = messages
        self.are_wanted, self.stop, self.address = node.are_wanted, node.close, node.source


class _Listener:
    """Tells of subscriptions; the server's other events need no answer."""

    def __init__(self, came: Callable[[str], None]) -> None:
        self._came = came

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._came(channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        pass
