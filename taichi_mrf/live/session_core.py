"""What live and tuning sessions share: the line to the page, and the requests that wait to be carried out.

One thread does all of a session's work, because Taichi has one owner. Between two pieces of work it takes in
what the page asks for. Requests that arrive faster than they are carried out do not pile up: a later one
replaces a waiting one of its kind (:class:`Inbox`).
"""

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import ClassVar

from taichi_mrf.live.link import Link
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
    Update,
)
from taichi_mrf.viewer.tune.messages import SaveTries

WAIT_SECONDS = 0.25
"""Longest delay before a signal is noticed while idle, in seconds."""

EDITS = (Switch, Freeze, Move, Reset)
"""Requests that change the map, and so cannot be carried out while it is being inferred."""

OF_ONE_KEYFRAME = (Switch, Freeze, Move)


class Inbox:
    """Requests that wait, the oldest first.

    A request replaces the last one about the same thing if that is of the same kind: of ten moves of a
    keyframe only the last is carried out, but a move, a freeze and another move stay three requests. A Reset
    drops all edits before it.
    """

    def __init__(self) -> None:
        self._waiting: deque[Request] = deque()

    def put(self, request: Request) -> None:
        """Add a request that has just come."""
        if isinstance(request, Reset):
            self._waiting = deque(each for each in self._waiting if not isinstance(each, (*EDITS, Step)))
        subject = _subject(request)
        before = next((each for each in reversed(self._waiting) if _subject(each) == subject), None)
        if type(before) is type(request):
            self._waiting = deque(each for each in self._waiting if each is not before)
        self._waiting.append(request)

    def take(self) -> Request:
        """The oldest request, which waits no longer."""
        return self._waiting.popleft()

    def put_back(self, requests: Iterable[Request]) -> None:
        """Requests that were taken, in their order, wait again before all others."""
        self._waiting.extendleft(reversed(list(requests)))

    @property
    def next(self) -> Request:
        """The oldest request."""
        return self._waiting[0]

    def has_edits(self) -> bool:
        """Whether a request that changes the map is waiting."""
        return any(isinstance(request, EDITS) for request in self._waiting)

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[Request]:
        return iter(self._waiting)


def _subject(request: Request) -> Hashable:
    """What a request is about."""
    if isinstance(request, OF_ONE_KEYFRAME):
        return "keyframe", request.keyframe
    if isinstance(request, Pause | Step):
        return "replay"
    if isinstance(request, Save):
        return "file", request.kind, request.client
    if isinstance(request, SaveTries):
        return "file", request.kind, request.number, request.client
    return type(request).__name__


class SessionCore:
    """The page's side of a session: ``link`` leads to it, ``inbox`` has its requests; ``ended`` says that the
    user has quit."""

    EXPECTED: ClassVar[type[Exception]] = Exception
    """What may go wrong with one piece of work without ending the session."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.inbox = Inbox()
        self.ended = False
        self.should_stop: Callable[[], bool] = lambda: False

    @property
    def is_over(self) -> bool:
        """Whether to do nothing more: a signal has come, the user has quit, or the page is gone."""
        return self.should_stop() or self.ended or self.link.lost is not None

    def hear(self) -> None:
        """Take in the requests that have come."""
        for request in self.link.requests():
            self.inbox.put(request)

    def send(self, update: Update) -> None:
        """Pass an update to the page."""
        self.link.send(update)

    def guarded(self, work: Callable[[], None]) -> bool:
        """Do some work. What goes wrong with one frame, one try or one request must not end the session, and
        becomes a notice. Returns whether it went well."""
        try:
            work()
        except self.EXPECTED as error:
            self.notice_error(error)
            return False
        return True

    def notice_error(self, error: Exception) -> None:
        """Tell the page what went wrong."""
        self.send(Notice(" ".join(str(error).split()) or type(error).__name__, "error"))
