"""A page of the viewer without a process behind it and without a browser."""

from collections.abc import Callable
from typing import Any

from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.transport.server import start_server


class HandledPage:
    """A page whose items are handled here, one by one; ``asked`` is what it asked of its process."""

    def __init__(self, new_page: Callable[..., Any], *items: Any) -> None:
        self.server = start_server("127.0.0.1", 0, "Handled")
        self.asked: list[m.Request] = []
        self.page = new_page(self.server, self.asked.append)
        self.take(*items)

    def take(self, *items: Any) -> None:
        for item in items:
            self.page.handlers[type(item)](item)
