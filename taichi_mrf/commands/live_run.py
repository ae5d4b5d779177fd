"""What ``taichi-mrf live`` does: start the page, map, and leave the files when it ends."""

import os
import sys
import time
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from taichi_mrf.commands.interrupt import StopRequest, stop_on_signals
from taichi_mrf.commands.live import Live
from taichi_mrf.commands.output import DID_NOT_FIT, output_folder
from taichi_mrf.config import with_absolute_tables
from taichi_mrf.errors import TaichiMRFError
from taichi_mrf.live.link import ViewerLink
from taichi_mrf.viewer.messages import Listening

LOOPBACK = ("127.0.0.1", "::1", "localhost")

NICENESS = 10
"""Mapping leaves the page the processor when both want it."""

SHORTEST_LIFE_SECONDS = 30.0
"""A viewer that ends sooner than this is not started once more."""


def run_live(options: Live) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = Console()

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True, markup=False)

    settings = with_absolute_tables(options.settings, Path.cwd())
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(output_folder(options.out))
        request = stack.enter_context(stop_on_signals(say))
        _warn_of_host(options, say)
        page = _Page(options, say, stack)
        # Only now, so that the viewer keeps its priority; and before Taichi starts threads, which inherit it.
        _be_nice()
        # Imported late: the page starts meanwhile, in a process of its own.
        from taichi_mrf.live.files import write_all
        from taichi_mrf.live.open_source import open_source
        from taichi_mrf.live.run import Policy
        from taichi_mrf.live.session import Session

        source, notes = open_source(
            options.source,
            settings,
            every=options.every,
            limit=options.limit,
            speed=options.speed,
            loop=options.loop,
            reading=options.reading,
        )
        for note in notes:
            say(note)
        policy = Policy(options.keep_live, options.out, options.exit_when_done)
        session = Session(source, page.link, policy, page.listening)
        problem = _run(session.run, session.reconnect, page, request)
        if options.out is not None:
            for path in write_all(session.state.mapper.map, source.config, options.out):
                say(f"wrote {path}")
    if problem is not None:
        raise TaichiMRFError(problem)
    if request.signal is not None:
        return 128 + request.signal
    if session.state.full is not None:
        print(f"taichi-mrf: {session.state.full}; what did fit is mapped", file=sys.stderr)
        return DID_NOT_FIT
    return 0


class _Page:
    """The viewer of the moment, and what is told of it on the terminal."""

    def __init__(self, options: Live, say: Callable[[str], None], stack: ExitStack) -> None:
        self._options, self._say, self._stack = options, say, stack
        self._wanted_port = options.port
        self.start()

    def start(self) -> None:
        """Start a viewer; it is closed with the stack."""
        self.has_listened, self.started = False, time.monotonic()
        self.link = self._stack.enter_context(ViewerLink(self._options.host, self._wanted_port))

    def listening(self, where: Listening) -> None:
        """Tell the user where the page is."""
        host = f"[{where.host}]" if ":" in where.host else where.host
        address = f"http://{host}:{where.port}"
        self._say(f"The map is at {address}  (Ctrl-C ends it)")
        if self._wanted_port not in (0, where.port):
            self._say(f"Port {self._wanted_port} is busy, so the page took {where.port}.")
        if self._options.open and not self.has_listened:
            webbrowser.open(address)
        self.has_listened, self._wanted_port = True, where.port


def _run(
    run: Callable[[StopRequest], None],
    reconnect: Callable[[ViewerLink], None],
    page: _Page,
    request: StopRequest,
) -> str | None:
    """Map to the end; a viewer that was killed is started once more. Returns what has ended the run, if that
    was not meant to be."""
    while True:
        run(request)
        lost = page.link.lost
        if lost is None or request():
            return None
        lives_long = time.monotonic() - page.started > SHORTEST_LIFE_SECONDS
        if not (page.has_listened and lives_long):
            return lost
        print(f"taichi-mrf: {lost}; starting another", file=sys.stderr)
        page.link.close()
        page.start()
        reconnect(page.link)


def _warn_of_host(options: Live, say: Callable[[str], None]) -> None:
    if options.host in LOOPBACK:
        return
    say(
        f"Warning: the page at --host {options.host} has no password: whoever can reach this machine can "
        "watch and change the map. It is safer to leave --host away and to tunnel from where you watch: "
        f"ssh -L {options.port}:127.0.0.1:{options.port} USER@THIS-MACHINE"
    )


def _be_nice() -> None:
    if hasattr(os, "nice"):  # not on Windows
        os.nice(NICENESS)
