"""Common part of robot clients, whatever the wire: the queue of messages that wait to be taken.

Images come faster than they can be mapped: the oldest that nobody has taken is dropped for a new one.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.sources import Channel

MOST_IMAGES = 64
"""Images that wait to be taken; two seconds of a camera, so that slow poses find theirs."""

RATE_S = 5.0
"""Seconds over which the rate of images is averaged."""

MOST_TIMES = 1000
"""Times of images that are counted: RATE_S at 200 Hz."""

MOST_OTHERS = 100_000
"""Other messages that wait to be taken: a quarter of an hour of tf at 100 Hz."""


@dataclass(frozen=True)
class Raw:
    """A message as it came: its channel, when it was logged or published, when it ``arrived_s`` on this
    machine's monotonic clock, and its bytes."""

    channel: Channel
    logged_ns: int
    arrived_s: float
    data: bytes


class Client(ABC):
    """A connection to a robot at an ``address``; ``source`` names it. ``channels`` are those that it has now
    by their topics, ``dropped`` counts the images of a topic that nobody took in time; ``problem`` says why
    nothing comes while the connection is lost."""

    def __init__(self, address: str, source: str) -> None:
        self.address, self.source = address, source
        self.channels: dict[str, Channel] = {}
        self.dropped: Counter[str] = Counter()
        self.problem = ""
        self._images: deque[tuple[int, Raw]] = deque()
        self._others: deque[tuple[int, Raw]] = deque(maxlen=MOST_OTHERS)
        self._times: dict[str, deque[float]] = {}
        self._came, self._lock = 0, threading.Lock()

    @abstractmethod
    def subscribe(self, topics: Collection[str]) -> None:
        """Ask for the messages of these topics and of no others, also of those that are advertised later."""

    @abstractmethod
    def close(self) -> None:
        """End the connection."""

    def take(self) -> list[Raw]:
        """The messages that have come since the last call, in the order in which they came."""
        with self._lock:
            found = sorted([*self._images, *self._others], key=lambda each: each[0])
            self._images.clear()
            self._others.clear()
        return [raw for _, raw in found]

    def rate_hz(self, topic: str) -> float:
        """Images of a topic a second, over the last RATE_S seconds."""
        since = time.monotonic() - RATE_S
        with self._lock:
            times = self._times.get(topic, deque())
            while times and times[0] < since:
                times.popleft()
            return len(times) / RATE_S

    def _keep(self, channel: Channel, logged_ns: int, data: bytes) -> None:
        """Keep a message that has come, until it is taken; who calls holds the lock."""
        self._came += 1
        raw = self._came, Raw(channel, logged_ns, time.monotonic(), data)
        if channel.type not in messages.OF_SENSORS:
            self._others.append(raw)
            return
        self._images.append(raw)
        self._times.setdefault(channel.topic, deque(maxlen=MOST_TIMES)).append(raw[1].arrived_s)
        if len(self._images) > MOST_IMAGES:
            _, oldest = self._images.popleft()
            self.dropped[oldest.channel.topic] += 1


def wait_until(done: Callable[[], bool], seconds: float, step_s: float = 0.01) -> bool:
    """Wait until ``done()``, for some seconds at most; returns whether it is."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() >= end:
            return False
        time.sleep(step_s)
    return True
