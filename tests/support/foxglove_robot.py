"""A robot that runs: a server of Foxglove's own library that sends the messages of a bag."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import foxglove
from rosbags.highlevel import AnyReader

from taichi_mrf.datasets.wires.foxglove import wait_until


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
class Robot:
    """``messages`` are (topic, time of recording in nanoseconds, bytes) in order."""

    bag: Path
    port: int
    listener: Listener = field(default_factory=Listener)
    sent: int = 0

    def __post_init__(self) -> None:
        self.context = foxglove.Context()
        self.messages: list[tuple[str, int, bytes]] = []
        self.channels: dict[str, Any] = {}
        with AnyReader([self.bag]) as reader:
            for each in reader.connections:
                name, text = each.msgtype, each.msgdef.data.encode()
                if not reader.is2:
                    name = name.replace("/msg/", "/")
                kind, encoding = ("ros2msg", "cdr") if reader.is2 else ("ros1msg", "ros1")
                schema = foxglove.Schema(name=name, encoding=kind, data=text)
                self.channels[each.topic] = foxglove.Channel(
                    each.topic, schema=schema, message_encoding=encoding, context=self.context
                )
            self.messages = [(each.topic, time, bytes(data)) for each, time, data in reader.messages()]
        self.start()

    @property
    def source(self) -> str:
        return f"foxglove:ws://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Listen, at the same port as before once the system lets go of it."""
        assert wait_until(self._starts, 20), f"port {self.port} is in use"

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

    def wait_for(self, *topics: str) -> None:
        """Wait until somebody has subscribed to some topics."""
        assert wait_until(lambda: set(topics) <= set(self.listener.topics), 20), self.listener.topics

    def send(self, *topics: str) -> None:
        """Send all messages, or those of some topics."""
        for topic, time, data in self.messages:
            if not topics or topic in topics:
                self.channels[topic].log(data, log_time=time)

    def send_next(self, count: int) -> None:
        """Send the next messages in the order of recording, as many as there are."""
        for topic, time, data in self.messages[self.sent : self.sent + count]:
            self.channels[topic].log(data, log_time=time)
        self.sent += count


@contextmanager
def robot(bag: Path, port: int = 0) -> Iterator[Robot]:
    """A robot that runs in the ``with`` block."""
    found = Robot(bag, port)
    try:
        yield found
    finally:
        found.stop()
