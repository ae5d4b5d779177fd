"""A run that does not end: an hour of keyframes, one a second, with and without freezing.

The built-in room is walked around again and again, each time with other noise. One map keeps every keyframe
and is inferred in full at the end; others keep a few, and freeze those that have left the view. All are
judged from viewpoints that are in no keyframe.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_mrf import MRFMap, open_dataset
from taichi_mrf.evaluation.accuracy import Tolerance, judge_view
from taichi_mrf.evaluation.experiments.exact import room_scene
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.mapping.selection import surplus
from taichi_mrf.system.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEYFRAMES = 3600
LAP = 240
"""Keyframes on the way around the room."""

SIZE = "&width=160&height=120"
KEPT = (24,)
JUDGED = 13
"""Views; they do not divide a lap, so that they lie between the keyframes."""

FIGURES: tuple[Tolerance, ...] = ("1.5sigma", "5cm", "sensor")


@dataclass(frozen=True)
class _Run:
    """``keep`` keyframes can still be changed; None: all, and the map is inferred in full at the end."""

    judged: Scene
    voxel_size: float
    keyframes: int
    keep: int | None

    def result(self) -> Result:
        """Accuracies, and after every keyframe the seconds that it took and the bytes of the map."""
        m = MRFMap(self.voxel_size, self.judged.noise, max_depth=self.judged.max_depth)
        seconds, megabytes = [], []
        lap = open_dataset(f"synthetic:room?frames={LAP}{SIZE}", color=False)
        for number in range(self.keyframes):
            if number % LAP == 0:
                lap = open_dataset(f"synthetic:room?frames={LAP}{SIZE}&seed={number // LAP}", color=False)
            frame = lap.read(number % LAP)
            start = time.perf_counter()
            id = m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
            if self.keep is not None:
                m.renew([id])
                for old in surplus(m, id, self.keep):
                    m.freeze_keyframe(old)
            seconds.append(time.perf_counter() - start)
            megabytes.append(_megabytes(m))
        if self.keep is None:
            m.infer()
            megabytes.append(_megabytes(m))
        return {"seconds": seconds, "mb": megabytes, **self._scores(m)}

    def _scores(self, m: MRFMap) -> dict[str, Any]:
        """Means over the judged views."""
        scored = [
            judge_view(
                m, view.true_m, view.T_world_camera, self.judged.camera,
                measured_m=view.measured_m, noise=self.judged.noise, mask=view.judged,
                by="omega",
            )
            for view in self.judged.views
        ]  # fmt: skip
        return {name: float(np.mean([each.accuracy(name).score for each in scored])) for name in FIGURES}


def _megabytes(m: MRFMap) -> float:
    size = m.statistics()
    return size.bytes_per_voxel * size.voxels / 1e6


def run_endless(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """Accuracy by the number of keyframes that are kept, and time and memory over the hour."""
    count = min(KEYFRAMES, experiment.limit or KEYFRAMES)
    judged = room_scene(JUDGED, SIZE)
    rows: list[list[Entry]] = []
    paths: list[Path] = []
    for voxel_size in experiment.voxel_sizes:
        results: dict[str, Result] = {}
        choices: Sequence[int | None] = (None, *KEPT)
        for number, keep in enumerate(choices):
            name = "all" if keep is None else str(keep)
            experiment.report(f"{voxel_size * 100:g} cm, {name} kept", number, len(choices))
            run = _Run(judged, voxel_size, count, keep)
            key = f"{count} keyframes | {name} | {voxel_size:g} m"
            results[name] = experiment.ledger.result(key, run.result)
        rows += _rows(voxel_size, results)
        path = experiment.out / f"endless_{voxel_size * 1000:g}mm.png"
        with atomic_path(path) as part:
            endless_figure(results).savefig(part, format="png", dpi=110)
        paths.append(path)
    table = Table(
        "endless",
        f"{count} keyframes of the built-in room, {LAP} a lap",
        ["kept", "voxels", *FIGURES, "points from all", "ms a keyframe, at first", "at last", "MB"],
        rows,
        [
            "Milliseconds: medians of the first and the last tenth.",
            "The time of 'all' is that of adding; it is inferred in full once, at the end.",
        ],
    )
    return [table], [*write_table(experiment.out, table), *paths]


def _rows(voxel_size: float, results: dict[str, Result]) -> list[list[Entry]]:
    rows = []
    for name, result in results.items():
        tenth = max(1, len(result["seconds"]) // 10)
        times = [
            1e3 * float(np.median(part)) for part in (result["seconds"][:tenth], result["seconds"][-tenth:])
        ]
        apart = max(100 * abs(result[f] - results["all"][f]) for f in FIGURES)
        accuracies = [result[f] for f in FIGURES]
        size = f"{voxel_size * 100:g} cm"
        rows.append([name, size, *accuracies, apart, *times, result["mb"][-1]])
    return rows


def endless_figure(results: dict[str, Result]) -> "Figure":
    """Milliseconds of a keyframe (medians of fifty) and megabytes of the map over the hour."""
    figure = new_figure(10.0, 4.0)
    left, right = figure.subplots(1, 2)
    for name, result in results.items():
        seconds = np.asarray(result["seconds"])
        parts = np.array_split(seconds, max(1, len(seconds) // 50))
        if name != "all":
            at = np.linspace(0, len(seconds), len(parts))
            left.plot(at, [1e3 * np.median(part) for part in parts], label=f"{name} kept")
        right.plot(result["mb"], label=f"{name} kept")
    left.set(xlabel="keyframes", ylabel="ms for a keyframe", ylim=(0, None))
    right.set(xlabel="keyframes", ylabel="MB of voxels and messages", yscale="log")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure
