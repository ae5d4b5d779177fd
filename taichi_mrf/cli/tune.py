"""Command ``taichi-mrf tune``: start the page, try parameters, and leave the files when it ends."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_mrf.cli.options.tune import FRAMES_BY_HAND, FRAMES_TO_SEARCH, Tune
from taichi_mrf.cli.shared.interrupt import StopRequest, stop_on_signals
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.serving import PrintLine, let_the_page_go_first, print_address, warn_of_host
from taichi_mrf.config.schema import Config, with_absolute_tables
from taichi_mrf.errors import TaichiMRFError
from taichi_mrf.session.link import ViewerLink
from taichi_mrf.system.atomic import write_text
from taichi_mrf.tune.link import NoPage, start_page
from taichi_mrf.viewer.tune.messages import FrameChoice

if TYPE_CHECKING:
    from taichi_mrf.calibration.from_recording import LearntSigma
    from taichi_mrf.datasets import Dataset
    from taichi_mrf.tune.history import Attempt
    from taichi_mrf.tune.search import Search
    from taichi_mrf.tune.session import TuneSession


def run_tune(options: Tune) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = open_terminal(options.printing)
    print_line = console.print_line

    settings = with_absolute_tables(options.settings, Path.cwd())
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(output_folder(options.out))
        request = stack.enter_context(stop_on_signals(print_line, keeps=options.out is not None))
        link = _page(options, print_line, stack) if options.viewer else NoPage()
        # Imported late: the page starts meanwhile, in a process of its own.
        from taichi_mrf.datasets import open_dataset
        from taichi_mrf.datasets.recorded_noise import with_tuned_noise
        from taichi_mrf.errors import DatasetError
        from taichi_mrf.session.session_core import Policy
        from taichi_mrf.system import runtime
        from taichi_mrf.tune.search import Search
        from taichi_mrf.tune.session import TuneSession

        runtime.init(settings.runtime.arch, settings.runtime.threads)
        dataset = open_dataset(options.source, color=False, **options.reading.keywords())
        if dataset.tracked:
            raise DatasetError(f"{options.source}: tune needs poses: map it, then add ?poses=trajectory.txt")
        settings = with_tuned_noise(settings, dataset)
        count = options.frames or (FRAMES_TO_SEARCH if options.auto is not None else FRAMES_BY_HAND)
        choice = FrameChoice(options.first, options.stride, count, options.hold_out)
        if options.noise.is_learnt:
            with ProgressBar(console, options.printing) as progress:
                learnt = _learn_noise(settings, dataset, choice, progress, request)
            settings = learnt.put_into(settings)
            _tell_noise(options, settings, learnt, print_line)
        search = None
        if options.auto is not None:
            search = Search(
                settings, options.names, options.auto, options.seed, options.search_stride, options.objective
            )
        printed: set[int] = set()
        session = TuneSession(
            dataset,
            settings,
            choice,
            link,
            Policy(options.out, leave_when_done=not options.viewer),
            search=search,
            listening=lambda where: print_address(where, "The page", options.port, options.open, print_line),
            tried=lambda attempt: _print_trial(attempt, session.search, printed, print_line),
            judged=lambda lines: _print_verdict(lines, print_line),
        )
        for note in dataset.notes:
            print_line(note)
        frames = session.frames
        print_line(
            f"{len(frames.training)} frames of {frames.source} make the map, {len(frames.held_out)} score it"
            + (f", {len(frames.unseen)} are kept back for the end" if frames.unseen else "")
            + f" (from frame {frames.choice.first} on, {frames.choice.stride} apart)"
        )
        session.run(request)
        _finish(session, options, print_line)
        lost = link.lost
    if lost is not None and not request():
        raise TaichiMRFError(lost)
    return request.exit_status


def _page(options: Tune, print_line: PrintLine, stack: ExitStack) -> ViewerLink:
    """Start the page, which may compute before the tries do."""
    warn_of_host(options.host, options.port, "use it", print_line)
    link = stack.enter_context(start_page(options.host, options.port))
    let_the_page_go_first()
    return link


def _learn_noise(
    settings: Config, dataset: "Dataset", choice: FrameChoice, progress: ProgressBar, request: StopRequest
) -> "LearntSigma":
    """Noise learnt from those frames of the recording that score no map. Raises TaichiMRFError."""
    from taichi_mrf.cli.shared.learn_noise import learn_noise
    from taichi_mrf.datasets.derived import chosen
    from taichi_mrf.tune.working_set import split_indices

    _, scored = split_indices(dataset, choice)
    others = sorted(set(range(len(dataset))) - set(scored))
    return learn_noise(chosen(dataset, others), settings, progress, request)


def _tell_noise(options: Tune, settings: Config, learnt: "LearntSigma", print_line: PrintLine) -> None:
    """Print what was learnt, and write it for other recordings."""
    from taichi_mrf.runs.files import NOISE_FILE
    from taichi_mrf.runs.noise import noise_notes, sensor_yaml

    for note in noise_notes(settings.sensor, None, learnt):
        print_line(note)
    if options.out is not None:
        write_text(options.out / NOISE_FILE, sensor_yaml(settings.sensor, options.source, learnt))
        print_line(f"wrote {options.out / NOISE_FILE}")


def _finish(session: "TuneSession", options: Tune, print_line: PrintLine) -> None:
    """Write the table of all tries, and the parameters that the search has found."""
    from taichi_mrf.tune.history import BEST_FILE, TABLE_FILE

    if options.out is None or not session.history.attempts:
        return
    write_text(options.out / TABLE_FILE, session.history.to_csv())
    print_line(f"wrote {options.out / TABLE_FILE}")
    best = session.best_yaml()
    if best is not None:
        write_text(options.out / BEST_FILE, best)
        print_line(f"wrote {options.out / BEST_FILE}")


def _print_verdict(lines: list[str], print_line: PrintLine) -> None:
    """Print the verdict as soon as the search has ended; the page stays up."""
    for line in lines:
        print_line(line)


def _print_trial(
    attempt: "Attempt", search: "Search | None", printed: set[int], print_line: PrintLine
) -> None:
    """One line for each try of the search, once; tries by hand are on the page."""
    if attempt.by != "search" or search is None or attempt.number in printed:
        return
    printed.add(attempt.number)
    scores = attempt.scores
    best = " *" if attempt.config == search.best else ""
    print_line(
        f"try {attempt.number:3}  log-likelihood {scores.log_likelihood:+.3f}  "
        f"right {scores.accuracy_sigma:.1%}  median {1000 * scores.median_abs_m:.1f} mm{best}"
    )
