"""Work of ``--noise auto`` before map, live and tune begin, with its progress on the terminal."""

from taichi_mrf.calibration.from_recording import MOST_MAPS, LearntSigma, learn_sigma
from taichi_mrf.cli.options.shared import Verbosity
from taichi_mrf.cli.shared.interrupt import StopRequest
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset


def learn_noise(
    dataset: Dataset,
    settings: Config,
    progress: ProgressBar,
    request: StopRequest,
    every: int = 1,
    limit: int | None = None,
) -> LearntSigma:
    """Learn sigma from ``limit`` of the frames 0, ``every``, ... of a dataset. Raises TaichiMRFError."""
    return learn_sigma(
        dataset,
        settings,
        every=every,
        limit=limit,
        on_map=lambda number: progress.advance("Learning noise", number - 1, MOST_MAPS),
        should_stop=request,
    )


def learn_with_bar(
    dataset: Dataset,
    settings: Config,
    console: Terminal,
    printing: Verbosity,
    request: StopRequest,
    every: int = 1,
    limit: int | None = None,
) -> LearntSigma:
    """:func:`learn_noise` where no progress is shown yet. Raises TaichiMRFError."""
    with ProgressBar(console, printing) as progress:
        return learn_noise(dataset, settings, progress, request, every, limit)
