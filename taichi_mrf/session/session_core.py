"""Common core of live and tuning sessions: the link to the page, and the requests that wait.

One thread does all of a session's work, because Taichi may be used by one thread only. Between two pieces of
work it reads the page's requests. Requests that arrive faster than they are carried out do not pile up: a
later one replaces a waiting one of its kind (:class:`WaitingRequests`).
"""

import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from taichi_mrf.session.link import Link
from taichi_mrf.system import compiling
from taichi_mrf.viewer.messages import (
    Freeze,
    Move,
    Notice,
    Pause,
    Request,
    Reset,
    Save,
    Step,
    Switch,
    Undo,
    Update,
)
from taichi_mrf.viewer.tune.messages import SaveTries

WAIT_SECONDS = 0.25
"""Longest delay before a signal is noticed while idle, in seconds."""

OF_KEYFRAMES = (Switch, Freeze, Move, Undo)

EDITS = (*OF_KEYFRAMES, Reset)
"""Requests that change the map, and so cannot be carried out while it is being inferred."""

IN_ORDER = (Switch, Freeze, Undo)
"""Edits of which each counts, as what it does depends on those before it."""

MOST_IN_ORDER = 1000
"""Edits that wait at most; more than that come from no hand, and are dropped."""

SEND_SECONDS = 0.02
"""Time in which words leave this process before the compiler of kernels takes Python's lock."""


class WaitingRequests:
    """The requests of the page that are not carried out yet, the oldest first.

    A request replaces the last one about the same thing if that is of the same kind: of ten moves of a
    keyframe only the last is carried out, but a move, a freeze and another move stay three requests, and so
    do three switches. A Reset drops all edits before it.
    """

    def __init__(self) -> None:
        self._waiting: deque[Request] = deque()

    def put(self, request: Request) -> None:
        """Add a request that has just arrived."""
        if isinstance(request, Reset):
            self._waiting = deque(each for each in self._waiting if not isinstance(each, (*EDITS, Step)))
        if isinstance(request, IN_ORDER):
            if len(self._waiting) < MOST_IN_ORDER:
                self._waiting.append(request)
            return
        subject, moves = _subject(request), isinstance(request, Move)
        related = (
            each
            for each in reversed(self._waiting)
            if _subject(each) == subject or (moves and isinstance(each, IN_ORDER))
        )
        before = next(related, None)
        if type(before) is type(request):
            self._waiting = deque(each for each in self._waiting if each is not before)
        self._waiting.append(request)

    def take(self) -> Request:
        """Remove and return the oldest request."""
        return self._waiting.popleft()

    def put_back(self, requests: Iterable[Request]) -> None:
        """Put requests that were taken back in front of all others, in their order."""
        self._waiting.extendleft(reversed(list(requests)))

    @property
    def next(self) -> Request:
        """The oldest request."""
        return self._waiting[0]

    def has_edits(self) -> bool:
        """True if a request that changes the map is waiting."""
        return any(isinstance(request, EDITS) for request in self._waiting)

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[Request]:
        return iter(self._waiting)


def _subject(request: Request) -> Hashable:
    """Subject of a request."""
    if isinstance(request, Move):
        return "keyframe", request.keyframe
    if isinstance(request, Pause | Step):
        return "replay"
    if isinstance(request, Save):
        return "file", request.kind, request.client
    if isinstance(request, SaveTries):
        return "file", request.kind, request.number, request.client
    return type(request).__name__


@dataclass(frozen=True)
class Policy:
    """Rules that a session follows without being asked. ``out``: folder for the files that a user saves.
    ``leave_when_done``: end once there is nothing left to do. ``keep_live``: most keyframes of a live run
    that are on before some are frozen, None for no limit."""

    out: Path | None = None
    leave_when_done: bool = False
    keep_live: int | None = None


class SessionCore:
    """The session's connection to its page, and the order of its work: ``link`` sends and receives,
    ``waiting`` holds the requests that are not carried out yet; ``ended``: the user has quit."""

    EXPECTED: ClassVar[type[Exception]] = Exception
    """Errors in one piece of work that do not end the session."""

    def __init__(self, link: Link, policy: Policy) -> None:
        self.link, self.policy = link, policy
        self.waiting = WaitingRequests()
        self.ended = False
        self.compiling = compiling.Waiting(self._show_compiling)
        self.should_stop: Callable[[], bool] = lambda: False

    @property
    def is_over(self) -> bool:
        """True if work has to stop: after a signal, after Quit, or when the page is lost."""
        return self.should_stop() or self.ended or self.link.lost is not None

    @property
    def is_done(self) -> bool:
        """True if a session without work has nothing to wait for but requests."""
        return True

    def work_until_over(
        self, should_stop: Callable[[], bool], answer: Callable[[], None], work: Callable[[], bool]
    ) -> None:
        """Work until told to stop: by ``should_stop``, by the viewer's Quit, or because the link is lost.

        ``answer`` carries out what the page has asked for, ``work`` does the next piece of work and returns
        whether there was any.
        """
        self.should_stop = should_stop
        with compiling.told(self.compiling):
            while not self.is_over:
                answer()
                if self.is_over or work():
                    continue
                if self.policy.leave_when_done and self.is_done:
                    return
                self.link.wait(self.idle())

    def idle(self) -> float:
        """Show that there is nothing to do; returns for how many seconds to wait at most."""
        return WAIT_SECONDS

    def read_requests(self) -> None:
        """Read the requests that have arrived."""
        for request in self.link.requests():
            self.waiting.put(request)

    def send(self, update: Update) -> None:
        """Send an update to the page."""
        self.compiling.step()
        self.link.send(update)

    def show_activity(self, activity: str, share: float) -> None:
        """Show the present activity on the page, and the share of it that is done, 0 to 1."""

    def _show_compiling(self, note: str) -> None:
        self.show_activity(note, 0.0)
        time.sleep(SEND_SECONDS)

    def guarded(self, work: Callable[[], None]) -> bool:
        """Do some work. An error with one frame, one try or one request does not end the session: it is shown
        as a notice. Returns whether the work succeeded."""
        try:
            work()
        except self.EXPECTED as error:
            self.notice_error(error)
            return False
        return True

    def notice_error(self, error: Exception) -> None:
        """Show an error on the page."""
        self.send(Notice(" ".join(str(error).split()) or type(error).__name__, "error"))
