"""Command ``taichi-mrf live``: start the page, map, and leave the files when it ends."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_mrf.cli.options.live import Live
from taichi_mrf.cli.shared.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal, tell_first_run
from taichi_mrf.cli.shared.serving import PrintLine, let_the_page_go_first, print_address, warn_of_host
from taichi_mrf.cli.shared.terminal import DID_NOT_FIT, print_problem
from taichi_mrf.config.schema import Config, with_absolute_tables
from taichi_mrf.errors import ConfigError, TaichiMRFError
from taichi_mrf.runs.files import holds_run
from taichi_mrf.session.link import ViewerLink
from taichi_mrf.viewer.messages import Listening, Status, Update

if TYPE_CHECKING:
    from taichi_mrf.calibration.from_recording import LearntSigma
    from taichi_mrf.datasets import Dataset

SHORTEST_LIFE_SECONDS = 30.0
"""A viewer that lives shorter than this is not restarted."""


def run_live(options: Live) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = open_terminal(options.printing)
    print_line = console.print_line

    settings = with_absolute_tables(options.poses.parameters(options.settings), Path.cwd())
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(output_folder(options.out))
            if holds_run(options.out) and not options.overwrite:
                raise ConfigError(
                    f"{options.out}: holds a run: choose another --out, or add --overwrite to replace it"
                )
        request = stack.enter_context(stop_on_signals(print_line, keeps=options.out is not None))
        warn_of_host(options.host, options.port, "watch and change the map", print_line)
        bar = ProgressBar(console, options.printing)
        page = _Page(options, print_line, bar, stack)
        tell_first_run(options.printing)
        let_the_page_go_first()
        # Imported late: the page starts meanwhile, in a process of its own.
        from taichi_mrf.cli.shared.learn_noise import learn_noise
        from taichi_mrf.runs.folder import write_run
        from taichi_mrf.session.session import Session
        from taichi_mrf.session.session_core import Policy
        from taichi_mrf.session.source import open_among, open_source

        def learn(dataset: "Dataset", config: Config) -> "LearntSigma":
            with ProgressBar(console, options.printing) as progress:
                return learn_noise(dataset, config, progress, request, options.every, options.limit)

        open_one = partial(
            open_source,
            config=settings,
            every=options.every,
            limit=options.limit,
            speed=options.speed,
            loop=options.loop,
            reading=options.reading,
            track=options.poses.track_poses,
            poses=options.poses.file,
            follow=options.poses.follow,
            learn_noise=learn if options.noise.is_learnt else None,
        )
        source, notes = open_among(options.source, open_one)
        if source.among is not None and options.out is not None:
            raise ConfigError(
                f"{options.source}: holds several recordings, and --out takes the files of one: pass one of "
                f"{', '.join(source.among.names[:8])}"
            )
        for note in notes:
            print_line(note)
        policy = Policy(options.out, options.exit_when_done, options.keep_live)
        session = Session(source, page.link, policy, page.listening)
        with bar:
            problem = _run(session.run, session.reconnect, page, request)
        page.link.ask_to_end()  # the page ends while the files are written
        if options.out is not None:
            state = session.state
            result = state.result()
            if result.track is not None:
                found, lost = len(result.track.frames), result.track.lost
                print_line(f"tracking: {found} frames found, {lost} lost, {result.loops_closed} loops closed")
            # A user who stops the run does not wait for the check and the pictures.
            whole = request.signal is None and not result.interrupted
            _, written = write_run(
                options.out, result, state.facts, check=whole, pictures=whole, haste=request
            )
            for path in written:
                print_line(f"wrote {path}")
    if problem is not None:
        raise TaichiMRFError(problem)
    if session.state.full is not None and not request():
        print_problem(f"out of memory: {session.state.full}; the map of the frames before it is kept")
        return DID_NOT_FIT
    return request.exit_status


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


class _Page:
    """The current viewer, and what is printed about it."""

    def __init__(self, options: Live, print_line: PrintLine, bar: ProgressBar, stack: ExitStack) -> None:
        self._options, self._print_line, self._bar, self._stack = options, print_line, bar, stack
        self._wanted_port = options.port
        self.start()

    def start(self) -> None:
        """Start a viewer; it is closed with the stack."""
        self.has_listened, self.started = False, time.monotonic()
        self.link = self._stack.enter_context(_ProgressLink(self._options.host, self._wanted_port, self._bar))

    def listening(self, where: Listening) -> None:
        """Tell the user where the page is."""
        wants_browser = self._options.open and not self.has_listened
        print_address(where, "The map", self._wanted_port, wants_browser, self._print_line)
        self.has_listened, self._wanted_port = True, where.port


def _run(
    run: Callable[[StopRequest], None],
    reconnect: Callable[[ViewerLink], None],
    page: _Page,
    request: StopRequest,
) -> str | None:
    """Map to the end; a viewer that was killed is restarted. Returns what ended the run, if that was not
    intended."""
    while True:
        run(request)
        lost = page.link.lost
        if lost is None or request():
            return None
        lives_long = time.monotonic() - page.started > SHORTEST_LIFE_SECONDS
        if not (page.has_listened and lives_long):
            return lost
        print_problem(f"{lost}; starting another")
        page.link.close()
        page.start()
        reconnect(page.link)
