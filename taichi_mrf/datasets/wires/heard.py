"""The topics of a robot that runs, as far as they have been heard, in the place of those of a bag."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.decoding import Decoder
from taichi_mrf.datasets.ros.sources import Channel, Entry, Topic, TopicSource, entry_of
from taichi_mrf.datasets.wires.client import MOST_IMAGES, Client
from taichi_mrf.datasets.wires.schemas import decoder_of
from taichi_mrf.errors import DatasetError, said
from taichi_mrf.system.libraries import library


class Heard(NamedTuple):
    """A message that has come, decoded, and when, on this machine's monotonic clock."""

    topic: Topic
    entry: Entry
    message: Any
    arrived_s: float


NEEDED = (*messages.OF_SENSORS, messages.CAMERA_INFO, *messages.TF, *messages.POSES)
"""The types of messages from which images of depth and point clouds are mapped."""


class HeardTopics(TopicSource):
    """Topics that a client hears. Until :meth:`forget` is called, messages are kept, of images the last
    MOST_IMAGES of a topic."""

    def __init__(self, client: Client) -> None:
        """Raises DatasetError if rosbags is not installed."""
        library("rosbags.highlevel", f"{client.source}: messages of ROS need", "ros", DatasetError)
        self.path, self.client = client.source, client
        self.topics = {}
        self.broken: Counter[str] = Counter()
        self.problem = ""
        self._decoder = Decoder()
        self._decoders: dict[Channel, Callable[[bytes], Any]] = {}
        self._kept: dict[str, deque[Heard]] | None = {}
        self._last: dict[str, Entry] = {}
        self._began = time.monotonic()
        self._learn()

    @property
    def duration(self) -> float:  # type: ignore[override]
        """Seconds since the first topic was asked for."""
        return time.monotonic() - self._began

    def hear(self) -> list[Heard]:
        """The messages that have come since the last call. One that cannot be decoded is left out, and
        counted in ``broken``; ``problem`` says why."""
        self._learn()
        found = []
        for raw in self.client.take():
            channel = raw.channel
            try:
                message = self._decoders[channel](raw.data)
            except Exception as error:  # the library raises many kinds of errors
                self.broken[channel.topic] += 1
                self.problem = f"{self.path}: topic {channel.topic}: cannot be read: {said(error)}"
                continue
            last = self._last.get(channel.topic)
            ordinal = last.ordinal + 1 if last is not None and last.recorded_ns == raw.logged_ns else 0
            entry = entry_of(message, raw.logged_ns, ordinal)
            topic = self.topics[channel.topic]
            self._last[channel.topic] = entry
            self.topics[channel.topic] = topic = replace(topic, messages=topic.messages + 1)
            found.append(Heard(topic, entry, message, raw.arrived_s))
            if self._kept is not None:
                most = MOST_IMAGES if topic.type in messages.OF_SENSORS else None
                self._kept.setdefault(topic.name, deque(maxlen=most)).append(found[-1])
        return found

    def forget(self) -> None:
        """Keep no messages any more."""
        self._kept = None

    def messages(self, topic: str) -> Iterator[tuple[Entry, Any]]:
        """Those that are kept."""
        return ((each.entry, each.message) for each in self.kept(topic))

    def kept(self, topic: str) -> list[Heard]:
        """The messages of a topic that are kept."""
        return [] if self._kept is None else list(self._kept.get(topic, ()))

    def read(self, topic: str, entry: Entry) -> Any:
        """One that is kept."""
        for each, message in self.messages(topic):
            if (each.recorded_ns, each.ordinal) == (entry.recorded_ns, entry.ordinal):  # stamps are mended
                return message
        raise DatasetError(f"{self.path}: topic {topic}: a message is no longer there")

    def _learn(self) -> None:
        """Learn the types of channels that are new."""
        new = [each for each in list(self.client.channels.values()) if each not in self._decoders]
        if not new:
            return
        for channel, problem in zip(new, self._decoder.learn(new), strict=True):
            self._decoders[channel] = partial(self._decoder.decode, channel.type, channel.encoding)
            try:
                if channel.schema:
                    self._decoders[channel], problem = decoder_of(channel), ""
            except Exception as error:  # descriptors may be anything
                problem = said(error)
            kind = f"{channel.type} ({problem})" if problem else channel.type
            known = self.topics.get(channel.topic)
            self.topics[channel.topic] = Topic(channel.topic, kind, known.messages if known else 0)
        self.topics = dict(sorted(self.topics.items()))
