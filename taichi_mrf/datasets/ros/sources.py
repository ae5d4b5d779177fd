"""Topics and their messages, whatever brings them: a bag (reader.py), or a robot that runs (wires/).

What is mapped is decided on a :class:`TopicSource` alone: which topic has depth, which camera took it, where
its poses come from.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_mrf.datasets.ros.messages import frame_name, header_ns

NANOSECONDS = 1_000_000_000
"""In a second. Stamps are divided by this whole number: 1e9 would round those of today to 256 ns before."""

Place = tuple[int, int]
"""The time of recording of a message in nanoseconds, and a number that grows along the recording."""


@dataclass(frozen=True)
class Channel:
    """A topic as its sender describes it: the ``type`` of its messages as ROS 2 writes it, their ``encoding``
    (cdr or ros1), and their ``definition`` in a ``language`` (MSG, IDL, or NONE without one). ``schema`` is
    Foxglove's own type that is read as this one, else empty."""

    topic: str
    type: str
    encoding: str
    language: str = "NONE"
    definition: str = ""
    schema: str = ""


@dataclass(frozen=True)
class Topic:
    """A topic: its message type as ROS 2 writes it, such as sensor_msgs/msg/Image, and why if its messages
    cannot be read; how many ``messages`` it has, so far if it is a robot's."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True)
class Entry:
    """Place of a message: recorded at ``recorded_ns``, the ``ordinal``-th of its topic (from 0) then."""

    recorded_ns: int
    ordinal: int
    stamp: float
    """The header's stamp in seconds, or the time of recording where there is no header or its stamp is 0."""

    frame: str = ""
    """The frame in the header."""

    publisher: str = ""
    """The node that sent it, which only ROS 1 records."""

    place: int = 0
    """Grows in the order of recording: its time, or the place in the file if that time starts again."""


def entry_of(
    message: Any, recorded_ns: int, ordinal: int, publisher: str = "", place: int | None = None
) -> Entry:
    """The entry of a message that was recorded at a time; ``place`` is that time unless it is given."""
    stamp, frame = recorded_ns / NANOSECONDS, ""
    header = getattr(message, "header", None)
    if header is not None:
        stamp = (header_ns(header) or recorded_ns) / NANOSECONDS
        frame = frame_name(header.frame_id)
    return Entry(recorded_ns, ordinal, stamp, frame, publisher, recorded_ns if place is None else place)


class TopicSource(ABC):
    """Topics by name, and their messages as objects with the fields of their type. ``path`` is the file or
    the address, which errors begin with; ``duration`` the seconds from the first message to the last."""

    path: Path | str
    topics: dict[str, Topic]
    duration: float
    by_file: bool = False
    """True if messages are told apart by their places in the file, as its times start again."""

    @abstractmethod
    def messages(self, topic: str) -> Iterator[tuple[Entry, Any]]:
        """All messages of a topic in the order of recording. Raises DatasetError, naming source and topic."""

    @abstractmethod
    def read(self, topic: str, entry: Entry) -> Any:
        """One message again. Raises DatasetError, which names source and topic."""

    def places(self, topic: str) -> list[Place]:
        """The places in the file of a topic's messages, in the order of ``messages``; none without a file, or
        if its index is damaged."""
        return []

    def first(self, topic: str) -> Any | None:
        """The first message of a topic, None if there is none."""
        return next((message for _, message in self.messages(topic)), None)
