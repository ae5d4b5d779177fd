"""The tuning application: parameters of sensor and map, by sliders in the browser or by a search.

    python apps/tune.py recording/ --auto 60 --out runs/tuned      in a clone
    taichi-mrf tune recording/ --auto 60 --out runs/tuned          installed: the same file

Some frames of a recording make a map for each set of parameters that is tried, others score it.
"""

import sys
from contextlib import ExitStack
from pathlib import Path

if __name__ == "__main__":  # the command line parses the options, and calls the function below
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    from taichi_mrf.cli.start import start

    sys.exit(start("tune"))

from taichi_mrf.cli.options.tune import FRAMES_BY_HAND, FRAMES_TO_SEARCH, Tune
from taichi_mrf.cli.shared.interrupt import stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import open_terminal
from taichi_mrf.cli.shared.serving import let_the_page_go_first, print_address, warn_of_host
from taichi_mrf.config.schema import with_absolute_tables
from taichi_mrf.errors import DatasetError, TaichiMRFError
from taichi_mrf.session.link import ViewerLink
from taichi_mrf.tune.link import NoPage, start_page
from taichi_mrf.viewer.tune.messages import FrameChoice


def run_tune(options: Tune) -> int:
    """Try parameters until the user or the search ends it; returns the exit status. Raises TaichiMRFError."""
    console = open_terminal(options.printing)
    print_line = console.print_line
    settings = with_absolute_tables(options.settings, Path.cwd())
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(output_folder(options.out))
        request = stack.enter_context(stop_on_signals(print_line, keeps=options.out is not None))

        # The page: it starts in a process of its own while this one loads what maps.
        link: ViewerLink | NoPage = NoPage()
        if options.viewer:
            warn_of_host(options.host, options.port, "use it", print_line)
            link = stack.enter_context(start_page(options.host, options.port))
            let_the_page_go_first()
        from taichi_mrf.cli import tune_lines as lines
        from taichi_mrf.cli.shared.learn_noise import learn_with_bar
        from taichi_mrf.datasets import open_dataset
        from taichi_mrf.datasets.derived import chosen
        from taichi_mrf.datasets.recorded_noise import with_tuned_noise
        from taichi_mrf.session.session_core import Policy
        from taichi_mrf.system import runtime
        from taichi_mrf.tune.search import Search
        from taichi_mrf.tune.session import TuneSession
        from taichi_mrf.tune.working_set import split_indices

        # The source: a recording with poses, the choice of its frames, and the parameters to begin with.
        runtime.init(settings.runtime.arch, settings.runtime.threads)
        dataset = open_dataset(options.source, color=False, **options.reading.keywords())
        if dataset.tracked:
            raise DatasetError(f"{options.source}: tune needs poses: map it, then add ?poses=trajectory.txt")
        settings = with_tuned_noise(settings, dataset)
        count = options.frames or (FRAMES_TO_SEARCH if options.auto is not None else FRAMES_BY_HAND)
        choice = FrameChoice(options.first, options.stride, count, options.hold_out)
        if options.noise.is_learnt:  # from frames that score no map
            others = sorted(set(range(len(dataset))) - set(split_indices(dataset, choice)[1]))
            learnt = learn_with_bar(chosen(dataset, others), settings, console, options.printing, request)
            settings = learnt.put_into(settings)
            lines.tell_noise(options, settings, learnt, print_line)
        search = None
        if options.auto is not None:
            search = Search(
                settings, options.names, options.auto, options.seed, options.search_stride, options.objective
            )

        # The loop: parameters that the page or the search asks for, a map with them, its scores, the page.
        printed: set[int] = set()
        session = TuneSession(
            dataset,
            settings,
            choice,
            link,
            Policy(options.out, leave_when_done=not options.viewer),
            search=search,
            listening=lambda where: print_address(where, "The page", options.port, options.open, print_line),
            tried=lambda attempt: lines.print_try(attempt, session.search, printed, print_line),
            judged=lambda verdict: lines.print_all(verdict, print_line),
        )
        lines.print_all(dataset.notes, print_line)
        lines.print_frames(session.frames, print_line)
        session.run(request)

        # The folder: the table of all tries, and the best parameters.
        lines.write_results(session, options.out, print_line)
        lost = link.lost
    if lost is not None and not request():
        raise TaichiMRFError(lost)
    return request.exit_status
