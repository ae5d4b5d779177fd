"""A long sequence in, one map in chunks out: survey, plan, rounds of inference and exchange, merge."""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from taichi_mrf.cluster.runner import TaskRunner
from taichi_mrf.cluster.submaps.plan import PLAN_FILE, Job, SourceFrames, plan_submaps
from taichi_mrf.cluster.submaps.round_files import (
    SubmapReport,
    read_core,
    read_layer,
    read_places,
    read_report,
    round_path,
)
from taichi_mrf.cluster.submaps.survey import find_keyframes
from taichi_mrf.cluster.submaps.task import SubmapTask, infer_submap, is_idle
from taichi_mrf.config.registry import METHODS, methods_with
from taichi_mrf.config.schema import Config
from taichi_mrf.config.values import from_dict
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.export.chunk_store import ChunkStore, new_store
from taichi_mrf.export.store_header import StoreHeader
from taichi_mrf.geometry.up import up_from_name, up_name
from taichi_mrf.inference.prior import log_odds_without_bricks
from taichi_mrf.inference.ray_model import Limits
from taichi_mrf.system.atomic import write_text
from taichi_mrf.voxels.layers import LOG_ODDS, BrickValues, known_log_odds
from taichi_mrf.voxels.layout import CHUNK, VOXELS

SETTLED = 0.001
"""The rounds end when at most this share of all voxels has changed in the last one."""

Progress = Callable[[str, int, int], None]
"""Called with the present activity, the number of its steps that are done, and how many there are."""


@dataclass(frozen=True)
class RoundReport:
    """A round: ``moved`` and ``halo_moved`` as in SubmapReport, over all submaps; ``seconds`` from its first
    task's begin to its last one's end, of a round that was resumed only of its last part."""

    round: int
    seconds: float
    moved: float | None
    halo_moved: float | None
    submaps: tuple[SubmapReport, ...]


@dataclass
class SubmapsResult:
    """Result of :func:`map_in_submaps`: the job, its rounds, and the ``seconds`` of each stage."""

    job: Job
    rounds: list[RoundReport] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)


def map_in_submaps(
    sequence: SourceFrames,
    config: Config,
    submap_size: float,
    folder: Path,
    map_path: Path,
    runner: TaskRunner,
    *,
    rounds: int,
    settled: float = SETTLED,
    resume: bool = False,
    skip_bad_frames: bool = False,
    infer: Callable[[SubmapTask], SubmapReport] = infer_submap,
    progress: Progress = lambda what, done, total: None,
) -> SubmapsResult:
    """Map a sequence in columns of ``submap_size`` metres, and write the map in chunks to ``map_path``.

    Every submap is inferred by itself, then up to ``rounds`` times again with the latest beliefs of its
    neighbours, until at most the share ``settled`` of the voxels changes. The tasks' files are kept in
    ``folder``, which all workers must see; with ``resume`` complete tasks are not repeated. ``infer`` is
    what the runner is given. Raises ConfigError for parameters that do not fit, or differ from those of the
    run to resume, and what datasets, maps and the runner raise.
    """
    _check(config, rounds)
    begin = time.perf_counter()
    result = SubmapsResult(
        _job(sequence, config, submap_size, folder, runner, resume, skip_bad_frames, progress)
    )
    result.seconds["planning"] = time.perf_counter() - begin
    for round in range(rounds + 1):
        report = _round(result.job, folder, round, round > 0 or rounds == 0, runner, infer, progress)
        result.rounds.append(report)
        # A round needs no more than the one before it.
        shutil.rmtree(folder / f"round-{round - 2:03d}", ignore_errors=True)
        if report.moved is not None and report.moved <= settled:
            break
    last = result.rounds[-1].round
    if not (folder / f"round-{last:03d}").is_dir():
        raise ConfigError(
            f"{folder}: is past round {last}, whose files are gone; --resume needs more --rounds"
        )
    result.seconds["inferring"] = sum(each.seconds for each in result.rounds)
    begin = time.perf_counter()
    progress("Merging", 0, 1)
    _merge(folder, result.job, last, map_path)
    result.seconds["merging"] = time.perf_counter() - begin
    return result


def _check(config: Config, rounds: int) -> None:
    if not METHODS[config.method].has_messages:
        raise ConfigError(f"submaps need the method {methods_with('has_messages')}, not {config.method}")
    if config.poses.refine:
        raise ConfigError("poses.refine does not work with submaps: no task sees all keyframes")
    if config.volume.window_m > 0:
        raise ConfigError("volume.window_m does not work with submaps: each task holds its part as a whole")
    if not config.time.is_static:
        raise ConfigError("submaps need a static world: time.half_life_s must be 0")
    if rounds < 0:
        raise ConfigError(f"--rounds must not be negative, not {rounds}")


def _job(
    sequence: SourceFrames,
    config: Config,
    submap_size: float,
    folder: Path,
    runner: TaskRunner,
    resume: bool,
    skip_bad_frames: bool,
    progress: Progress,
) -> Job:
    """The job of the run to go on with, or a new one."""
    config = with_recorded_noise(config, sequence.open())
    if resume and (folder / PLAN_FILE).exists():
        job = Job.read(folder)
        changed = job.differences(sequence, config, submap_size)
        if changed:
            raise ConfigError(
                f"{folder / PLAN_FILE}: made with another {', '.join(changed)}; "
                "--resume needs the same parameters"
            )
        if job.config != config:  # in what makes no other map
            job = replace(job, config=config)
            job.write(folder)
        return job
    _empty(folder)
    progress("Planning", 0, 1)
    keyframes, skipped = find_keyframes(
        sequence, config, runner, skip_bad_frames, lambda done, total: progress("Planning", done, total)
    )
    plan = plan_submaps(keyframes, submap_size, config.voxel_size)
    centres_m = {k.index: k.centre_m for k in keyframes}
    images = tuple(sorted({name for k in keyframes for name in k.images}))
    job = Job(sequence, config, submap_size, plan, centres_m, skipped, up_name(keyframes[0].up), images)
    job.write(folder)
    return job


def _empty(folder: Path) -> None:
    """Make way for the files of a new run. Raises MapFileError if the folder holds what no run writes."""
    ours = (PLAN_FILE, "round-", ".")
    foreign = [p.name for p in folder.iterdir() if not p.name.startswith(ours)] if folder.is_dir() else []
    if foreign:
        raise MapFileError(
            f"{folder}: holds {min(foreign)}, which no run in submaps writes; it is left alone"
        )
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    except OSError as error:
        raise MapFileError(f"{folder}: cannot be made: {error.strerror or error}") from error


def _round(
    job: Job,
    folder: Path,
    round: int,
    may_be_last: bool,
    runner: TaskRunner,
    infer: Callable[[SubmapTask], SubmapReport],
    progress: Progress,
) -> RoundReport:
    """Carry out a round, or read its report if it is complete."""
    path = folder / f"round-{round:03d}.json"
    if path.exists():
        return _read_round(path)
    begin = time.perf_counter()
    # The largest first, so that none of them is left for the end.
    order = sorted(range(len(job.plan.submaps)), key=lambda n: -len(job.plan.submaps[n].keyframes))
    done: list[int] = []
    what = "Inferring" if round == 0 else f"Round {round}"
    progress(what, 0, len(order))

    def count(number: int, report: SubmapReport) -> None:
        done.append(number)
        progress(what, len(done), len(order))

    tasks = [SubmapTask(str(folder.resolve()), number, round, may_be_last) for number in order]
    idle = {task for task in tasks if is_idle(task)}
    reports = [infer_submap(task) for task in tasks if task in idle]
    for number, report in enumerate(reports):
        count(number, report)
    reports += runner.run(infer, [task for task in tasks if task not in idle], count)
    reports.sort(key=lambda report: report.submap)
    found = RoundReport(
        round=round,
        seconds=time.perf_counter() - begin,
        moved=_mean(reports, "moved"),
        halo_moved=_mean(reports, "halo_moved"),
        submaps=tuple(reports),
    )
    write_text(path, json.dumps(asdict(found)) + "\n")
    return found


def _read_round(path: Path) -> RoundReport:
    try:
        return from_dict(RoundReport, json.loads(path.read_text(encoding="utf-8")), str(path))
    except (OSError, ValueError) as error:
        raise MapFileError(f"{path}: not a readable report of a round: {error}") from error


def _mean(reports: list[SubmapReport], name: str) -> float | None:
    """A share of the voxels of all submaps, each with the weight of its core."""
    values = [(getattr(report, name), report.core_bricks) for report in reports]
    known = [(value, weight) for value, weight in values if value is not None]
    return sum(v * w for v, w in known) / max(1, sum(w for _, w in known)) if known else None


def _merge(folder: Path, job: Job, round: int, path: Path) -> None:
    """Write the cores of all submaps after a round as one map in chunks. A chunk belongs to one submap
    alone, so each is written once, and only one submap's core is in memory at a time. Raises MapFileError."""
    files = [round_path(folder, round, number) for number in range(len(job.plan.submaps))]
    config, up = job.config, up_from_name(job.up) if job.up else None
    log_odds = log_odds_without_bricks(config.inference, config.voxel_size, Limits().message)
    header = StoreHeader.of(config, *log_odds, config.volume.min_evidence, up)
    chunks = [np.unique(np.concatenate(read_places(file)) // CHUNK, axis=0) for file in files]
    with new_store(path) as place:
        layers = job.layers
        store = ChunkStore.create(place, header, np.unique(np.concatenate(chunks), axis=0), layers=layers)
        for file in files:
            for name in () if read_report(file).has_nothing else layers:
                store.write({name: read_layer(file, name)})
            bricks, belief, free = read_core(file)
            empty = np.full((len(free), VOXELS), header.seen_free_log_odds, np.float32)
            bricks, belief = np.concatenate([bricks, free]), np.concatenate([belief, empty])
            store.write({LOG_ODDS: BrickValues(bricks, known_log_odds(belief, header.prior_log_odds))})
        store.fill(store.chunks)
