"""Signals that stop a run and keep its work.

The first Ctrl-C asks a run to save what it has and to end, the second aborts it. SIGTERM asks the same within
seconds, because containers and schedulers kill it after ten: inference is cut short, too. SIGHUP, which a
broken connection or a closed terminal sends, means what SIGTERM means, however often it is sent.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from taichi_mrf.errors import CutShortError

INFER_SECONDS = 3.0
"""Time for inference after SIGTERM: containers kill after 10 s, and the map has yet to be saved."""

_HANG_UP = getattr(signal, "SIGHUP", None)  # not on Windows


class StopRequest:
    """Request to end the run with what it has, and how; an instance is called to ask if there is one."""

    def __init__(self) -> None:
        self.signal: int | None = None
        """The signal that came first."""
        self.aborted = False
        """True if the user has asked the run to end at once, without its results."""
        self._killed_from: float | None = None  # the time of SIGTERM or SIGHUP
        self._cuts_short = False

    def __call__(self) -> bool:
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """0, or what a shell expects of a program that was stopped by a signal."""
        return 0 if self.signal is None else 128 + self.signal

    def out_of_time(self) -> bool:
        """True if computing has to end now, so that enough time is left to save (SIGTERM, SIGHUP)."""
        return self._killed_from is not None and time.monotonic() - self._killed_from > INFER_SECONDS

    @contextmanager
    def cutting_short(self) -> Iterator[None]:
        """For a block that may be left at any point: CutShortError is raised in it as soon as the run is to
        end."""
        self._cuts_short = True
        try:
            if self():
                raise CutShortError
            yield
        finally:
            self._cuts_short = False

    @contextmanager
    def ending(self) -> Iterator[None]:
        """For a block in which this process waits for others: the first signal ends it, and no more."""
        try:
            yield
        except KeyboardInterrupt:
            if self.aborted or not self():
                raise

    def take(self, number: int) -> bool:
        """Note a signal; returns whether it changes anything. Raises KeyboardInterrupt if it aborts."""
        if number == _HANG_UP:
            _let_go_of_the_terminal()
        kills = number != signal.SIGINT
        repeated = self() and (self._killed_from is not None or not kills)
        if repeated and number != _HANG_UP:
            self.aborted = True
            raise KeyboardInterrupt
        if kills and self._killed_from is None:
            self._killed_from = time.monotonic()
        if self():
            return False
        self.signal = number
        if self._cuts_short:
            raise CutShortError
        return True


@contextmanager
def stop_on_signals(announce: Callable[[str], None], keeps: bool = True) -> Iterator[StopRequest]:
    """While the block runs, SIGINT, SIGTERM and SIGHUP only set the yielded request and announce it; a second
    SIGINT or SIGTERM raises KeyboardInterrupt. ``keeps``: whether the run saves what is done."""
    with _handled(announce, keeps, raise_at_once=False) as request:
        yield request


@contextmanager
def interrupt_on_signals(announce: Callable[[str], None]) -> Iterator[StopRequest]:
    """:func:`stop_on_signals` for work that other processes do: already the first signal raises
    KeyboardInterrupt, for the waiting to end."""
    with _handled(announce, keeps=True, raise_at_once=True) as request:
        yield request


@contextmanager
def _handled(announce: Callable[[str], None], keeps: bool, raise_at_once: bool) -> Iterator[StopRequest]:
    request = StopRequest()
    announcing: list[threading.Thread] = []

    def announce_outcome() -> None:
        outcome = "What is done so far is saved." if keeps else "Nothing is saved: there is no --out."
        with contextlib.suppress(OSError):  # the terminal may be gone
            announce(f"Stopping. {outcome} Press Ctrl-C again to abort.")

    def handle(number: int, frame: FrameType | None) -> None:
        if not request.take(number):
            return
        # The signal may come while this thread prints, and a stream refuses a thread's write within a write.
        announcing.append(threading.Thread(target=announce_outcome))
        announcing[-1].start()
        if raise_at_once:
            raise KeyboardInterrupt

    # Under nohup, SIGHUP is ignored, and stays so.
    numbers = [number for number in (signal.SIGINT, signal.SIGTERM, _HANG_UP) if _is_taken(number)]
    saved = {number: signal.signal(number, handle) for number in numbers if number is not None}
    try:
        yield request
    finally:
        for number, handler in saved.items():
            signal.signal(number, handler)
        for thread in announcing:
            thread.join()


def _is_taken(number: int | None) -> bool:
    return number is not None and (number != _HANG_UP or signal.getsignal(number) != signal.SIG_IGN)


def _let_go_of_the_terminal() -> None:
    """Redirect a closed terminal to nowhere: an error while printing must not end a run before it saves."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(ValueError, AttributeError):  # a stream of a test has no descriptor
            descriptor = stream.fileno()
            try:
                os.write(descriptor, b"")
            except OSError:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
