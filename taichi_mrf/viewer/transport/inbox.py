"""The page's inbox, and the events in it.

Updates come into the inbox from the mapping process, events from the browsers; None ends the page, whose
own thread takes them out. viser runs callbacks on a pool of threads: a callback only puts an event into the
inbox.
"""

import queue
from dataclasses import dataclass

from taichi_mrf.viewer.messages import Update


class Event:
    """Base of what a user or a browser does; the pages add their own."""


@dataclass(frozen=True)
class Joined(Event):
    """A browser has connected."""

    client: int


@dataclass(frozen=True)
class OptionsMoved(Event):
    """A widget of the view options was used; the latest values count."""


@dataclass(frozen=True)
class Used(Event):
    """A client used the widget of an action: it pressed the button, or changed the value. The action has the
    name of the widget."""

    action: str
    client: int


Item = Update | Event | None


class Inbox(queue.SimpleQueue[Item]):
    """A queue that any thread may fill."""

    def wait(self, patience_s: float | None) -> list[Item]:
        """All items in the queue. Waits for the first one for at most ``patience_s`` seconds (None: without
        limit), and returns an empty list if none has come by then."""
        try:
            batch = [self.get(timeout=patience_s)]
        except queue.Empty:
            return []
        while not self.empty():
            batch.append(self.get())
        return batch
