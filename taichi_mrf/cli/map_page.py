"""The page of ``taichi-mrf live``: its process, what the terminal says of it, another one if it is killed."""

import time
from contextlib import ExitStack

from taichi_mrf.cli.options.live import Live
from taichi_mrf.cli.shared.interrupt import StopRequest
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.serving import PrintLine, let_the_page_go_first, print_address, warn_of_host
from taichi_mrf.cli.shared.terminal import print_problem
from taichi_mrf.errors import TaichiMRFError
from taichi_mrf.session.link import ViewerLink
from taichi_mrf.viewer.messages import Listening, Notice, Status, Update

SHORTEST_LIFE_SECONDS = 30.0
"""A viewer that lives shorter than this is not restarted."""


class MapPage:
    """The current viewer, ``link`` to it, and what is printed about it. It is closed with the ``stack``."""

    def __init__(self, options: Live, print_line: PrintLine, bar: ProgressBar, stack: ExitStack) -> None:
        """Start it; from then on this process has the lower priority."""
        self._options, self._print_line, self._bar, self._stack = options, print_line, bar, stack
        self._wanted_port = options.port
        self._has_listened = False
        self._problem: str | None = None
        warn_of_host(options.host, options.port, "watch and change the map", print_line)
        self._start()
        let_the_page_go_first()

    def listening(self, where: Listening) -> None:
        """Tell the user where the page is."""
        wants_browser = self._options.open and not self._has_listened
        print_address(where, "The map", self._wanted_port, wants_browser, self._print_line)
        self._has_listened, self._wanted_port = True, where.port

    def wait_for(self, text: str) -> None:
        """Tell the user what is waited for before there is a map."""
        self._print_line(text)
        self.link.send(Notice(text))

    def starts_again(self, request: StopRequest) -> bool:
        """Look why a session has ended; returns True if its viewer was killed, and another was started for it
        to go on with."""
        lost = self.link.lost
        if lost is None or request():
            return False
        lives_long = time.monotonic() - self._started > SHORTEST_LIFE_SECONDS
        if not (self._has_listened and lives_long):
            self._problem = lost
            return False
        print_problem(f"{lost}; starting another")
        self.link.close()
        self._start()
        return True

    def refuse_early_end(self) -> None:
        """Raise TaichiMRFError if the viewer has ended before its time, and was not started again."""
        if self._problem is not None:
            raise TaichiMRFError(self._problem)

    def _start(self) -> None:
        self._has_listened, self._started = False, time.monotonic()
        self.link = self._stack.enter_context(_ProgressLink(self._options.host, self._wanted_port, self._bar))


class _ProgressLink(ViewerLink):
    """A link that also shows the progress on the terminal."""

    def __init__(self, host: str, port: int, bar: ProgressBar) -> None:
        super().__init__(host, port)
        self._bar = bar
        self._shown = (0, 0)

    def send(self, update: Update) -> None:
        """Pass an update on."""
        super().send(update)
        if isinstance(update, Status) and (update.frame, update.keyframes) != self._shown:
            self._shown = update.frame, update.keyframes
            note = f"{update.keyframes} keyframes, {update.keyframes_per_second:.1f} keyframes/s"
            self._bar.advance("Frame", update.frame, update.frames or None, note=note)
