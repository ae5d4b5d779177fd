"""The inbox of a page: everything that happens goes in, and the page's own thread takes it out.

Updates come from the mapping process, events from the browsers; None says that it is time to end.
"""

import queue

from taichi_mrf.viewer.events import Event
from taichi_mrf.viewer.messages import Update

Item = Update | Event | None


class Inbox:
    """A queue that any thread may fill."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Item] = queue.SimpleQueue()

    def put(self, item: Item) -> None:
        """Add one thing; returns at once."""
        self._queue.put(item)

    def wait(self, patience_s: float | None) -> list[Item]:
        """All that is there; if nothing is, the first thing that comes, or nothing after so many seconds
        (None: however long it takes)."""
        try:
            batch = [self._queue.get(timeout=patience_s)]
        except queue.Empty:
            return []
        while not self._queue.empty():
            batch.append(self._queue.get())
        return batch
