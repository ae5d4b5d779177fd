"""A robot that sends a bag, what a client of its wire hears, and frames made of it, which are the bag's."""

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.wires import stream
from taichi_mrf.datasets.wires.client import Client, Raw, wait_until
from taichi_mrf.sensor.frame import Frame

SECONDS = 20


@dataclass
class Sender(ABC):
    """A robot that runs in a ``with`` block, and is stopped at its end; its kind says how it sends.
    ``messages`` are (topic, time of recording in nanoseconds, bytes) in order."""

    bag: Path
    port: int = 0
    messages: list[tuple[str, int, bytes]] = field(default_factory=list, init=False)
    sent: int = field(default=0, init=False)

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    @abstractmethod
    def stop(self) -> None:
        """End it."""

    @abstractmethod
    def listened(self) -> set[str]:
        """The topics that somebody listens to."""

    @abstractmethod
    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        """Send one message."""

    def wait_for(self, *topics: str) -> None:
        """Wait until somebody listens to some topics."""
        assert wait_until(lambda: set(topics) <= self.listened(), SECONDS), self.listened()

    def send_next(self, count: int) -> None:
        """Send the next messages in the order of recording, as many as there are."""
        for each in self.messages[self.sent : self.sent + count]:
            self.put(*each)
        self.sent += count

    @contextmanager
    def sending(self, count: int, *topics: str) -> Iterator[None]:
        """It sends its next messages in the meantime, once somebody listens to some topics."""
        thread = Thread(target=lambda: (self.wait_for(*topics), self.send_next(count)))
        thread.start()
        try:
            yield
        finally:
            thread.join()


def heard(client: Client, count: int) -> list[Raw]:
    """The messages that come, once they are ``count``."""
    found: list[Raw] = []

    def enough() -> bool:
        found.extend(client.take())
        return len(found) >= count

    assert wait_until(enough, SECONDS), f"{len(found)} of {count} messages"
    return found


def begun(sender: Any, first: int, query: str = "", listen_to: str = "/odom", color: bool = False) -> Dataset:
    """The dataset of a robot that has sent its first messages while it was listened to."""

    with sender.sending(first, listen_to):
        return open_dataset(sender.source + query, color=color)


def whole(live: Dataset) -> stream.Robot:
    """The robot behind what mends its frames."""
    while hasattr(live, "source"):
        live = live.source
    assert isinstance(live, stream.Robot)
    return live


def came(live: Dataset) -> int:
    """Images that have come so far."""
    live.awaiting()
    return whole(live)._came


def follow_bag(sender: Any, live: Dataset, bag: Path, count: int) -> None:
    """A robot sends an image, and then the pose after it: each frame is that of the bag, bit for bit."""
    recorded = open_dataset(bag, color=False)
    assert live.endless
    assert live.camera == recorded.camera
    for number in range(count):
        assert wait_until(lambda number=number: came(live) == number + 1, SECONDS)
        assert "the next image" in live.awaiting()  # the pose after it has not come
        sender.send_next(1)
        assert wait_until(lambda: not live.awaiting(), SECONDS)
        sender.send_next(1)
        ours, theirs = live.read(number), recorded.read(number)
        assert ours.camera == theirs.camera
        assert_same_frame(ours, theirs)


def assert_same_frame(ours: Frame, theirs: Frame, named: bool = True) -> None:
    """Bit for bit; of a name and stamp too unless one is numbered otherwise."""
    assert not named or (ours.name, ours.stamp) == (theirs.name, theirs.stamp)
    for part in ("depth_m", "no_return", "points_m", "sigma_m", "color", "T_world_camera"):
        np.testing.assert_array_equal(getattr(ours, part), getattr(theirs, part))


def has_heard(live: Dataset, count: int) -> bool:
    return heard_by(whole(live)) == count


def heard_by(live: stream.Robot) -> int:
    """Messages that have been heard so far."""
    live.awaiting()
    return sum(topic.messages for topic in live.heard.topics.values())


def one_by_one(sender: Any, live: Dataset, pause_s: float = 0.0) -> list[Frame]:
    """The frames of what the robot sends, when each message is heard, and a pause made, before the next is
    sent."""
    found, heard = [], heard_by(whole(live))
    while sender.sent < len(sender.messages):
        time.sleep(pause_s)
        heard += sender.messages[sender.sent][0] in sender.listener.topics
        sender.send_next(1)
        assert wait_until(partial(has_heard, live, heard), SECONDS)
        if not live.awaiting():
            found.append(live.read(0))
    return found
