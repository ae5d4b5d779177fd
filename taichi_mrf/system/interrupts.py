"""Ctrl-C waits while a map is being changed, so that it never leaves half a change, or is noted."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """While the block runs, SIGINT is only noted; afterwards its handler is called, which by default raises
    KeyboardInterrupt. Outside the main thread, where Python handles no signals, nothing is done."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    noted: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: noted.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if noted:
            handler(*noted[0])


@contextmanager
def interrupts_noted() -> Iterator[Callable[[], bool]]:
    """While the block runs, the first SIGINT is only noted; the function tells whether it came. An exception
    that a signal raises can be lost, as in a finaliser. A second one is handled as before the block. Outside
    the main thread nothing is noted."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield lambda: False
        return
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if len(came) > 1:
            handler(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(came)
    finally:
        signal.signal(signal.SIGINT, handler)
