"""One submap in one round: a function of the plan's file, the recording and the files of the round before.

A task may run anywhere that sees those files, at any time, and again after it was killed: it writes one file,
which is whole or not there.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from taichi_mrf.cluster.submaps.partial_map import PartialMap
from taichi_mrf.cluster.submaps.plan import Job
from taichi_mrf.cluster.submaps.round_files import (
    Bricks,
    Halo,
    LogOdds,
    RoundResult,
    SubmapReport,
    read_core,
    read_halo,
    read_report,
    round_path,
    write_round,
)
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.mapping.settling import FullInference
from taichi_mrf.queries.points import probability
from taichi_mrf.system import runtime
from taichi_mrf.system.memory import peak_memory_mb, reset_peak_memory
from taichi_mrf.voxels.layers import FIRST, SURFACE, BrickValues
from taichi_mrf.voxels.layout import grid_keys

MOVED = 0.01
"""A probability that changes by more than this from one round to the next counts as moved."""


@dataclass(frozen=True)
class SubmapTask:
    """Infer a submap of the plan in ``folder`` in a round, 0 being the one before any exchange. In a round
    that ``may_be_last`` the other layers of the map (Job.layers) are made too."""

    folder: str
    submap: int
    round: int
    may_be_last: bool = True

    def __str__(self) -> str:
        return f"submap {self.submap} in round {self.round}"


def infer_submap(
    task: SubmapTask, on_step: Callable[[InferProgress], None] = lambda step: None
) -> SubmapReport:
    """Infer a submap with the evidence of its neighbours from the round before, and write the result.

    Does nothing if the result is there already. ``on_step`` is called after each keyframe's sweep. Raises
    MapFileError, DatasetError, CapacityError.
    """
    folder = Path(task.folder)
    path = round_path(folder, task.round, task.submap)
    if path.exists():
        return read_report(path)
    before = round_path(folder, task.round - 1, task.submap)
    if is_idle(task):
        report = replace(read_report(before), round=task.round, seconds=0.0, moved=0.0, halo_moved=0.0)
        bricks, belief, free = read_core(before)
        write_round(path, RoundResult(bricks, belief, free, {}, report))
        return report
    result = _inferred(task, Job.read(folder), on_step)
    if task.round > 0:
        told = [(evidence, read_halo(before, other)) for other, (_, evidence) in result.halos.items()]
        report = replace(
            result.report,
            moved=share_moved([(result.belief, read_core(before)[1])]),
            halo_moved=share_moved([(now, then[1]) for now, then in told if then is not None]),
        )
        result = replace(result, report=report)
    write_round(path, result)
    return result.report


def is_idle(task: SubmapTask) -> bool:
    """True if the result is that of the round before: rays only pass through this column, and they are the
    same in every round."""
    before = round_path(Path(task.folder), task.round - 1, task.submap)
    return task.round > 0 and read_report(before).has_nothing


def _inferred(task: SubmapTask, job: Job, on_step: Callable[[InferProgress], None]) -> RoundResult:
    begin = time.perf_counter()
    settings = job.config.runtime
    runtime.init(settings.arch, settings.threads)
    reset_peak_memory()
    m, id_of = _with_keyframes(job, task.submap)
    core = _core(job, task.submap, m.bricks())
    crossed = _core(job, task.submap, m.all_crossed_bricks())
    free = crossed[~np.isin(grid_keys(crossed), grid_keys(core))]
    measured = 0
    if job.config.keep_surface:
        measured = len(_core(job, task.submap, m.measured_bricks()))
    heard, inferring = 0, 0.0
    halos: dict[int, Halo] = {}
    if len(core) or measured:
        neighbours = job.plan.neighbours(task.submap)
        heard = _listen(m, task, neighbours)
        with FullInference(m) as inference:
            for step in inference:
                on_step(step)
        assert inference.outcome is not None
        inferring = inference.outcome.seconds
        halos = _spoken(m, job, task.submap, {n: [id_of[i] for i in c] for n, c in neighbours.items()})
    layers = _layers(m, job, task, core) if task.may_be_last else {}
    belief, size = m.beliefs(core), m.statistics()
    report = SubmapReport(
        submap=task.submap,
        round=task.round,
        keyframes=size.keyframes,
        rays=size.rays,
        core_bricks=len(core),
        free_bricks=len(free),
        halo_bricks=heard,
        seconds=round(time.perf_counter() - begin, 3),
        inferring_seconds=round(inferring, 3),
        map_mb=round(size.memory_mb, 3),
        peak_memory_mb=peak_memory_mb(),
        surface_bricks=measured,
    )
    return RoundResult(core, belief, free, halos, report, layers)


def _layers(m: PartialMap, job: Job, task: SubmapTask, core: Bricks) -> dict[str, BrickValues]:
    """The layers of the core that are wanted beside log-odds."""
    slots, fed = m.slots(core), m.pixel_layers
    found = {name: BrickValues(core, fed[name].within(slots)) for name in job.layers if name in fed}
    if SURFACE in job.layers:
        field = m.surface_field()
        rows = job.plan.is_core(task.submap, field.bricks) & field.weight.any(axis=1)
        found[SURFACE] = field.values.chosen(rows)
    if FIRST in job.layers:
        found[FIRST] = BrickValues(core, m.first_surfaces()[slots])
    return found


def _core(job: Job, submap: int, bricks: Bricks) -> Bricks:
    return bricks[job.plan.is_core(submap, bricks)]


def _with_keyframes(job: Job, submap: int) -> tuple[PartialMap, dict[int, int]]:
    """The submap's map, not yet inferred, and each keyframe's id in it by its index in the dataset."""
    dataset = job.sequence.open(job.config.color)
    m = PartialMap.from_config(job.config, dataset.camera)
    id_of = {}
    for index in job.plan.submaps[submap].keyframes:
        id_of[index] = m.add(dataset.read(index))
    return m, id_of


def _listen(m: PartialMap, task: SubmapTask, neighbours: Iterable[int]) -> int:
    """Take in the evidence of neighbours from the round before; returns its number of bricks."""
    heard = 0
    for other in neighbours if task.round > 0 else ():
        halo = read_halo(round_path(Path(task.folder), task.round - 1, other), task.submap)
        if halo is not None:
            m.assume(*halo)
            heard += len(halo[0])
    return heard


def _spoken(m: PartialMap, job: Job, submap: int, common: dict[int, list[int]]) -> dict[int, Halo]:
    """The evidence of the core for each neighbour: the beliefs without the messages of the keyframes (ids)
    that both have, in the bricks that rays of those cross."""
    halos = {}
    for other, ids in common.items():
        bricks = _core(job, submap, m.seen_bricks(ids))
        if len(bricks):
            halos[other] = bricks, m.beliefs(bricks, without=ids)
    return halos


def share_moved(pairs: list[tuple[LogOdds, LogOdds]]) -> float:
    """The share of voxels, over pairs of log-odds, whose probability differs by more than MOVED."""
    moved = sum(int((np.abs(probability(a) - probability(b)) > MOVED).sum()) for a, b in pairs)
    return moved / max(1, sum(a.size for a, _ in pairs))
