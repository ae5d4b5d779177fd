"""The live application: a map grows in the browser while frames arrive, and is changed there.

    python apps/live.py recording/ --out runs/desk      in a clone
    taichi-mrf live recording/ --out runs/desk          installed: the same file

This process maps, another one serves the page. The session goes round in a loop: it carries out what the page
asks for, takes the next frame if one is due, infers, and sends what has changed.
"""

import sys
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path

if __name__ == "__main__":  # the command line parses the options, and calls the function below
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    from taichi_mrf.cli.start import start

    sys.exit(start("live"))

from taichi_mrf.cli.map_page import MapPage
from taichi_mrf.cli.options.config_file import live_defaults
from taichi_mrf.cli.options.live import Live
from taichi_mrf.cli.shared.interrupt import stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal, tell_first_run
from taichi_mrf.cli.shared.terminal import DID_NOT_FIT, print_problem
from taichi_mrf.config.schema import with_absolute_tables
from taichi_mrf.errors import ConfigError, CutShortError
from taichi_mrf.session.files import holds_run


def run_live(options: Live) -> int:
    """Serve the page and map until the user ends it; returns the exit status. Raises TaichiMRFError."""
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
        server = options.publishing.serve(stack, print_line)

        # The page: it starts in a process of its own while this one loads what maps.
        bar = ProgressBar(console, options.printing)
        page = MapPage(options, print_line, bar, stack)
        tell_first_run(options.printing)
        from taichi_mrf.cli.map.task import settings_onto
        from taichi_mrf.cli.shared.learn_noise import learn_with_bar
        from taichi_mrf.session.folder import NO_HASTE, write_run
        from taichi_mrf.session.session import Session
        from taichi_mrf.session.session_core import Policy
        from taichi_mrf.session.source import open_among, open_source

        # The source: a recording or a camera with an empty map or that of an earlier day, or a saved map.
        if options.onto is not None:
            settings = settings_onto(options.onto, settings, live_defaults())
        learn = partial(
            learn_with_bar,
            console=console,
            printing=options.printing,
            request=request,
            every=options.every,
            limit=options.limit,
        )
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
            onto=options.onto,
            frozen=options.frozen,
            wait_for=page.wait_for,
        )
        try:  # nothing is kept of a robot that has not been located
            with nullcontext() if options.onto is None else request.cutting_short():
                source, notes = open_among(options.source, open_one)
        except CutShortError:
            return request.exit_status
        if source.among is not None and options.out is not None:
            raise ConfigError(
                f"{options.source}: holds several recordings, and --out takes the files of one: pass one of "
                f"{', '.join(source.among.names[:8])}"
            )
        for note in notes:
            print_line(note)

        # The map, and the loop: requests of the page, frames that are due, inference, what has changed.
        policy = Policy(options.out, options.exit_when_done, options.keep_live)
        session = Session(source, page.link, policy, page.listening, server)
        with bar:
            session.run(request)
            while page.starts_again(request):
                session.reconnect(page.link)
                session.run(request)
        page.link.ask_to_end()  # the page ends while the files are written

        # The folder: the files of a batch run. A user who stops does not wait for the check and the pictures.
        if options.out is not None:
            result = session.state.result()
            if result.track is not None:
                found, lost = len(result.track.frames), result.track.lost
                print_line(f"tracking: {found} frames found, {lost} lost, {result.loops_closed} loops closed")
            whole = request.signal is None and not result.interrupted
            facts = session.state.facts
            _, written = write_run(
                options.out, result, facts, check=whole, pictures=whole, haste=request if whole else NO_HASTE
            )
            for path in written:
                print_line(f"wrote {path}")
    page.refuse_early_end()
    if session.state.full is not None and not request():
        print_problem(f"out of memory: {session.state.full}; the map of the frames before it is kept")
        return DID_NOT_FIT
    return request.exit_status
