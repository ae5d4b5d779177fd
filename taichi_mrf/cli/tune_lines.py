"""Output of ``taichi-mrf tune``: the lines on its trials, and the files that it leaves."""

from pathlib import Path

from taichi_mrf.calibration.from_recording import LearntSigma
from taichi_mrf.cli.options.tune import Tune
from taichi_mrf.cli.shared.serving import PrintLine
from taichi_mrf.config.schema import Config
from taichi_mrf.session.files import NOISE_FILE
from taichi_mrf.session.noise import noise_notes, sensor_yaml
from taichi_mrf.system.atomic import write_text
from taichi_mrf.tune.history import BEST_FILE, TABLE_FILE, Attempt
from taichi_mrf.tune.search import Search
from taichi_mrf.tune.session import TuneSession
from taichi_mrf.tune.working_set import WorkingSet


def tell_noise(options: Tune, settings: Config, learnt: LearntSigma, print_line: PrintLine) -> None:
    """Print what was learnt, and write it for other recordings."""
    for note in noise_notes(settings.sensor, None, learnt):
        print_line(note)
    if options.out is not None:
        text = sensor_yaml(settings.sensor, options.source, learnt)
        _write(options.out / NOISE_FILE, text, print_line)


def print_frames(frames: WorkingSet, print_line: PrintLine) -> None:
    """Say which frames are used for what."""
    print_line(
        f"{len(frames.training)} frames of {frames.source} make the map, {len(frames.held_out)} score it"
        + (f", {len(frames.unseen)} are held back for the end" if frames.unseen else "")
        + f" (from frame {frames.choice.first} on, {frames.choice.stride} apart)"
    )


def print_try(attempt: Attempt, search: Search | None, printed: set[int], print_line: PrintLine) -> None:
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


def print_all(lines: list[str], print_line: PrintLine) -> None:
    """Print several lines: notes on the recording, or the verdict on what the search has found."""
    for line in lines:
        print_line(line)


def write_results(session: TuneSession, out: Path | None, print_line: PrintLine) -> None:
    """Write the table of all tries, and the parameters that the search has found."""
    if out is None or not session.history.attempts:
        return
    _write(out / TABLE_FILE, session.history.to_csv(), print_line)
    best = session.best_yaml()
    if best is not None:
        _write(out / BEST_FILE, best, print_line)


def _write(path: Path, text: str, print_line: PrintLine) -> None:
    write_text(path, text)
    print_line(f"wrote {path}")
