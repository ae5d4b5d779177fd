"""What live and tuning sessions share: the link to the page, and the requests that wait.

One thread does all of a session's work, because Taichi may be used by one thread only. Between two pieces of
work it reads the page's requests. Requests that arrive faster than they are carried out do not pile up: a
later one replaces a waiting one of its kind (:class:`Inbox`).
"""

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import ClassVar

from taichi_mrf.session.link import Link
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
        """Add a request that has just arrived."""
        if isinstance(request, Reset):
            self._waiting = deque(each for each in self._waiting if not isinstance(each, (*EDITS, Step)))
        subject = _subject(request)
        before = next((each for each in reversed(self._waiting) if _subject(each) == subject), None)
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
    """The session's connection to its page: ``link`` sends and receives, ``inbox`` holds the requests that
    wait; ``ended``: the user has quit."""

    EXPECTED: ClassVar[type[Exception]] = Exception
    """Errors in one piece of work that do not end the session."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.inbox = Inbox()
        self.ended = False
        self.should_stop: Callable[[], bool] = lambda: False

    @property
    def is_over(self) -> bool:
        """Whether to stop working: after a signal, after Quit, or when the page is lost."""
        return self.should_stop() or self.ended or self.link.lost is not None

    def read_requests(self) -> None:
        """Read the requests that have arrived."""
        for request in self.link.requests():
            self.inbox.put(request)

    def send(self, update: Update) -> None:
        """Send an update to the page."""
        self.link.send(update)

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
