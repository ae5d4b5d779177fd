"""The most that independent log-odds can do (one update a ray, bias removed, weights tuned), and the rows of
tables made from the figures of many views, beside what the paper reports.

Weights are tuned for each fold on its own training views: maps of all of these but one are judged on that
one, by what the sensor measured there. The same maps are judged on the fold's test view as well, never to
choose, but to show what a wrong choice of weights costs.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from taichi_mrf.evaluation.experiments.contenders import Contender, log_odds
from taichi_mrf.evaluation.experiments.folds import Experiment, Scored, flatten, fold_key
from taichi_mrf.evaluation.experiments.judging import build_and_judge
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.evaluation.tables import Entry, Spread, Table

COLUMNS: dict[str, str] = {
    "voxel": "voxel",
    "1.5sigma": "1.5sigma",
    "5cm": "5cm",
    "leaving": "1.5sigma, leaving",
    "unanswered": "unanswered",
    "sensor": "noisy, sensor",
    "median_abs": "median error (m)",
    "rms": "RMS error (m)",
    "expected_median_abs": "median error of the mean (m)",
    "log_likelihood": "log-likelihood",
}
"""Figure -> heading."""

HOW_TO_READ = (
    "Share of pixels whose surface is right: that of the largest omega (row omega, the paper's metric), for "
    "MRFMap the measured surface where it is near. voxel = the depth lies in its voxel; "
    "1.5sigma = within 1.5 voxels (sigma = one voxel); 5cm = within 5 cm.",
    "1.5sigma, leaving = the paper's rule of all pixels with a depth: a ray that keeps more than half of its "
    "visibility up to the map's boundary is right if its depth lies beyond.",
    "Unanswered rays count as wrong. noisy, sensor = the noisy depth within 1.5 sigma of what the sensor "
    "would measure of that surface. Log-likelihood: mean per measured pixel, nats, density per metre.",
)


def score_table(
    name: str,
    title: str,
    scored: Sequence[Scored],
    paper: Mapping[tuple[str, float], Spread],
    notes: Sequence[str] = (),
) -> Table:
    """One row for each contender's reading and voxel size: mean and spread over views (and noise seeds).

    ``paper`` gives, by (row, voxel size), what the paper reports under its own tolerance.
    """
    rows: list[list[Entry]] = []
    sizes = sorted({each.voxel_size for each in scored}, reverse=True)
    names = list(dict.fromkeys(each.row for each in scored))
    for size in sizes:
        for row in names:
            here = [each for each in scored if each.row == row and each.voxel_size == size]
            if not here:
                continue
            figures: list[Entry] = [Spread.of([each.figures[key] for each in here]) for key in COLUMNS]
            reported = paper.get((row, size))
            seconds = Spread.of([each.build_seconds for each in here])
            rows.append([f"{size * 100:g} cm", row, *figures, reported, Spread(seconds.mean), len(here)])
    return Table(
        name,
        title,
        ["voxels", "map", *COLUMNS.values(), "paper", "map (s)", "views"],
        rows,
        [*HOW_TO_READ, *notes],
    )


NAME = "log-odds per ray, tuned"


@dataclass(frozen=True)
class Weights:
    """Log-odds that a ray adds to the voxel that it ends in, and to one that it passes through."""

    hit: float
    miss: float

    @property
    def name(self) -> str:
        """As a row of a table is called."""
        return f"hit {self.hit:g}, miss {self.miss:g}"

    def contender(self) -> Contender:
        """Log-odds clamped as MRFMap's beliefs are seen (cavity_clamp), so that the clamp decides nothing."""
        return log_odds(
            f"log-odds per ray ({self.name})",
            update="ray",
            correct_bias=True,
            hit=_probability(self.hit),
            miss=_probability(self.miss),
            lowest=_probability(-9.2),
            highest=_probability(9.2),
        )


GRID: Sequence[Weights] = tuple(
    Weights(hit, round(-share * hit, 3)) for hit in (0.3, 1.0, 3.0) for share in (0.2, 0.4, 0.8)
)
"""From cautious to bold; OctoMap's own weights are 0.85 and -0.41."""

EVERY = 4
"""One fold in so many is tuned: each takes as many maps as the grid has weights."""

MOST_KEYFRAMES = 12
"""Weights for a map of more keyframes are tuned on so many of them, evenly spread."""


def tuned_leave_one_out(
    experiment: Experiment, scene: Scene, seed: int, voxel_size: float
) -> tuple[list[Scored], list[Scored]]:
    """(tuned, mistuned): a fold's test view under the weights chosen for it, with a map of all training
    views; and under every weight of the grid, with a map that lacks the view that they are tuned on."""
    count = len(scene.views)
    tuned: list[Scored] = []
    every: list[Scored] = []
    for fold in range(0, count, EVERY)[: experiment.limit]:
        others = [i for i in range(count) if i != fold]
        check = (fold + 1) % count
        tried = _try_weights(experiment, scene, seed, voxel_size, others, check, beside=[fold])
        every += [each for views in tried.values() for each in views if each.view == scene.views[fold].name]
        contender = _best(tried, scene.views[check].name).contender()
        result = experiment.ledger.result(
            fold_key(scene, seed, contender, voxel_size, f"{fold} left out"),
            lambda c=contender, o=others, f=fold: build_and_judge(c, scene, voxel_size, o, [f]),  # type: ignore[misc]
        )
        tuned += flatten(result, NAME, voxel_size, seed)
    return tuned, every


def tuned_contender(
    experiment: Experiment, scene: Scene, seed: int, voxel_size: float, keyframes: Sequence[int]
) -> Contender:
    """Log-odds with weights tuned on the keyframes: maps of some of them are judged on one of these."""
    some = keyframes[:: -(-len(keyframes) // MOST_KEYFRAMES)]
    check = some[len(some) // 2]
    tried = _try_weights(experiment, scene, seed, voxel_size, some, check)
    return dataclasses.replace(_best(tried, scene.views[check].name).contender(), name=NAME)


def _try_weights(
    experiment: Experiment,
    scene: Scene,
    seed: int,
    voxel_size: float,
    training: Sequence[int],
    check: int,
    beside: Sequence[int] = (),
) -> dict[Weights, list[Scored]]:
    """For all weights, maps of the training views but ``check``, judged on that one and on others beside."""
    views = [i for i in training if i != check]
    tried = {}
    for number, weights in enumerate(GRID):
        experiment.report(
            f"tuning log-odds for {scene.views[check].name}, {voxel_size * 100:g} cm", number, len(GRID)
        )
        contender = weights.contender()
        result = experiment.ledger.result(
            fold_key(
                scene, seed, contender, voxel_size, f"{check} and {list(beside)} of {len(views)} left out"
            ),
            lambda c=contender: build_and_judge(c, scene, voxel_size, views, [check, *beside]),  # type: ignore[misc]
        )
        tried[weights] = list(flatten(result, contender.name, voxel_size, seed))
    return tried


def _best(tried: dict[Weights, list[Scored]], view: str) -> Weights:
    """The weights whose map explains what was measured in a view best, in either reading."""
    return max(tried, key=lambda weights: max(e.figures["sensor"] for e in tried[weights] if e.view == view))


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))
