"""The result of a search: scores of the parameters that it has found on views that were used neither for
maps nor for the search."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from taichi_mrf.config.inference import InferenceConfig
from taichi_mrf.config.schema import Config
from taichi_mrf.tune.trial import GoOn, run_trial
from taichi_mrf.tune.working_set import WorkingSet
from taichi_mrf.viewer.tune.scores import KINDS, Scores

SHIPPED, STARTED, FOUND = "shipped defaults", "where the search began", "found"


@dataclass(frozen=True)
class Judged:
    """One line of the verdict."""

    name: str
    config: Config
    scores: Scores


def contenders(start: Config, found: Config) -> list[tuple[str, Config]]:
    """The configurations to compare: the shipped defaults with the same voxel size, method and density of
    outliers, which is the recording's, the start of the search if it differs, and the result."""
    changed: dict[str, Any] = {
        "inference": dataclasses.replace(InferenceConfig(), outlier_floor=start.inference.outlier_floor)
    }
    shipped = dataclasses.replace(
        Config(),
        voxel_size=start.voxel_size,
        method=start.method,
        volume=start.volume,
        evaluation=start.evaluation,
        runtime=start.runtime,
        **changed,
    )
    between = [] if start == shipped else [(STARTED, start)]
    return [(SHIPPED, shipped), *between, (FOUND, found)]


def judge_unseen(
    frames: WorkingSet, compared: Sequence[tuple[str, Config]], go_on: GoOn
) -> list[Judged] | None:
    """Map the training frames with each of some parameters, with all pixels, and score the maps on the
    unseen frames; None if that was abandoned. Raises what mapping raises."""
    lines = []
    for name, config in compared:
        trial = run_trial(config, frames, judged=frames.unseen, go_on=go_on)
        if trial is None:
            return None
        lines.append(Judged(name, config, trial.scores))
    return lines


def verdict_lines(judged: Sequence[Judged], views: int) -> list[str]:
    """The verdict as text, one line for each score: all contenders, and how the last differs from the
    first."""
    width = max(len(kind.label) for kind in KINDS)
    columns = [max(len(each.name), 10) for each in judged]
    head = "  ".join(f"{each.name:>{column}}" for each, column in zip(judged, columns, strict=True))
    lines = [f"Scores on {views} views that were never looked at before:", f"  {'':{width}}  {head}  change"]
    for kind in KINDS:
        values = [kind.value(each.scores) for each in judged]
        if not any(map(math.isfinite, values)):
            continue
        texts = "  ".join(f"{kind.format(v):>{c}}" for v, c in zip(values, columns, strict=True))
        change = f"{(values[-1] - values[0]) * kind.factor:+{kind.form.lstrip('+')}}"
        lines.append(f"  {kind.label:{width}}  {texts}  {change}")
    return lines
