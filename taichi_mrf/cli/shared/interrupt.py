"""Ctrl-C that keeps the work: the first press asks a run to finish early, the second aborts it."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class StopRequest:
    """Whether, and by which signal, the run was asked to stop; and whether it was told to abort then."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self.aborted = False

    def __call__(self) -> bool:
        return self.signal is not None


@contextmanager
def stop_on_signals(tell: Callable[[str], None]) -> Iterator[StopRequest]:
    """While the block runs, SIGINT and SIGTERM only set the yielded request and tell so; a second one
    raises KeyboardInterrupt."""
    with _handled(tell, raise_at_once=False) as request:
        yield request


@contextmanager
def interrupt_on_signals(tell: Callable[[str], None]) -> Iterator[StopRequest]:
    """The same for work that other processes do: already the first signal raises KeyboardInterrupt, for the
    waiting to end."""
    with _handled(tell, raise_at_once=True) as request:
        yield request


@contextmanager
def _handled(tell: Callable[[str], None], raise_at_once: bool) -> Iterator[StopRequest]:
    request = StopRequest()

    def handle(number: int, frame: FrameType | None) -> None:
        if request():
            request.aborted = True
            raise KeyboardInterrupt
        request.signal = number
        tell("Stopping: what is done so far will be kept. Once more to abort.")
        if raise_at_once:
            raise KeyboardInterrupt

    saved = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in saved.items():
            signal.signal(number, handler)
