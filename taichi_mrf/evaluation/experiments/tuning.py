"""The most that independent log-odds can do: one update a ray, bias removed, weights tuned.

Weights are tuned for each fold on its own training views: maps of all of these but one are judged on that
one, by what the sensor measured there. The same maps are judged on the fold's test view as well, never to
choose, but to show what a wrong choice of weights costs.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from taichi_mrf.evaluation.experiments.contenders import Contender, log_odds
from taichi_mrf.evaluation.experiments.folds import Experiment, Scored, flatten, fold_key
from taichi_mrf.evaluation.experiments.judging import build_and_judge
from taichi_mrf.evaluation.experiments.scenes import Scene

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


def tuned_leave_one_out(
    experiment: Experiment, scene: Scene, seed: int, voxel_size: float
) -> tuple[list[Scored], list[Scored]]:
    """(tuned, mistuned): the fold's test view under the weights chosen for it, with a map of all training
    views; and under every weight of the grid, with a map that lacks the view that they are tuned on."""
    count = len(scene.views)
    folds = range(0, count, EVERY)[: experiment.limit]
    tuned: list[Scored] = []
    every: list[Scored] = []
    for position, fold in enumerate(folds):
        best, best_score = GRID[0], -math.inf
        check = (fold + 1) % count
        for number, weights in enumerate(GRID):
            experiment.report(
                f"tuning log-odds, {voxel_size * 100:g} cm",
                position * len(GRID) + number,
                len(folds) * len(GRID),
            )
            training = [i for i in range(count) if i not in (fold, check)]
            contender = weights.contender()
            result = experiment.ledger.result(
                fold_key(scene, seed, contender, voxel_size, f"{fold} and {check} left out"),
                lambda c=contender, t=training, j=(check, fold): build_and_judge(c, scene, voxel_size, t, j),  # type: ignore[misc]
            )
            views = list(flatten(result, contender.name, voxel_size, seed))
            every += [each for each in views if each.view == scene.views[fold].name]
            scores = [each.figures["sensor"] for each in views if each.view == scene.views[check].name]
            score = max(scores)
            if score > best_score:
                best, best_score = weights, score
        contender = best.contender()
        others = [i for i in range(count) if i != fold]
        result = experiment.ledger.result(
            fold_key(scene, seed, contender, voxel_size, f"{fold} left out"),
            lambda c=contender, o=others, f=fold: build_and_judge(c, scene, voxel_size, o, [f]),  # type: ignore[misc]
        )
        tuned += flatten(result, NAME, voxel_size, seed)
    return tuned, every


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))
