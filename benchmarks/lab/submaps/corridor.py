"""Maps larger than one machine: the built-in corridor in submaps against the map of a single machine."""

import math
import shutil
import time
from dataclasses import asdict, replace
from pathlib import Path

from benchmarks.lab.submaps.costs import MeasuredCost, costs_table
from benchmarks.lab.submaps.equality import KilledOnce, compare, infer_or_be_killed
from taichi_mrf import ChunkedMap, Config
from taichi_mrf.cluster.local import LocalProcesses
from taichi_mrf.cluster.submaps.plan import Job, Plan, SourceFrames, Submap
from taichi_mrf.cluster.submaps.rounds import SETTLED, SubmapsResult, map_in_submaps
from taichi_mrf.config.schema import EvaluationConfig
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.synthetic.corridor import HALF_WIDTH, NAME, corridor_length
from taichi_mrf.datasets.synthetic.room_furniture import LENGTH
from taichi_mrf.datasets.synthetic.room_furniture import WIDTH as ROOM_WIDTH
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.tables import Entry, Table, write_table
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.capabilities import has_messages
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.voxels.layout import CHUNK_VOXELS

FRAMES, ROOMS, ROUNDS, JOBS = 520, 12, 2, 2
WIDTH, HEIGHT = 80, 60
SUBMAP_M = 6.4
FULL_WIDTH, FULL_HEIGHT, FULL_FRAMES = 640, 480, 8
"""A few frames of a real camera's size, for what a keyframe costs."""

APART = "no overlap"
BYTES_PER_VOXEL = 8.0
"""Of belief and evidence in a task's memory; messages count as the keyframes'."""

NOTES = (
    "within 0.02: share of the voxels whose probability differs by no more than that, of all voxels near "
    "surfaces and of those that are known in the single map; same state: also of seen-free space",
    "round 0 is before any exchange; both maps make the same number of sweeps, the submaps in each round; in "
    "round 1 a worker is killed in the middle of a task",
    "no overlap: each keyframe only in the submap where its camera was, to show what the comparison can see",
)


def run_submaps(experiment: Experiment) -> tuple[list[Table], list[Path]]:
    """The share of equal voxels after each round of exchange, and what larger places would need."""
    rows: list[list[Entry]] = []
    costs, notes = [], []
    frames = FRAMES if experiment.limit is None else min(FRAMES, experiment.limit)
    for number, voxel_size in enumerate(experiment.voxel_sizes):
        experiment.report(f"{voxel_size * 100:g} cm", number, len(experiment.voxel_sizes))
        scene = f"{NAME} with {ROOMS} rooms, {frames} frames of {WIDTH} x {HEIGHT}"
        key = f"{scene} | {voxel_size:g} m | submaps of {SUBMAP_M:g} m, {ROUNDS} rounds"
        result = experiment.ledger.result(key, lambda v=voxel_size: measure(experiment, v, frames))  # type: ignore[misc]
        rows += _rows(voxel_size, result)
        notes.append(_note(voxel_size, result))
        costs.append(MeasuredCost(**result["cost"]))
    columns = [
        "voxels", "round", "within 0.02 (%)", "known within 0.02 (%)", "same state (%)", "largest difference",
        "moved (%)", "told moved (%)", "seconds",
    ]  # fmt: skip
    title = "A map made of submaps against a single machine's"
    table = Table("submaps", title, columns, rows, [*NOTES, *notes])
    tables = [table, costs_table(costs)]
    return tables, [path for each in tables for path in write_table(experiment.out, each)]


def measure(experiment: Experiment, voxel_size: float, frames: int) -> Result:
    """Map the corridor both ways, and compare after each round."""
    source = f"{NAME}?rooms={ROOMS}&frames={frames}&width={WIDTH}&height={HEIGHT}"
    config = Config(voxel_size, evaluation=EvaluationConfig(hold_out=0))
    sequence = SourceFrames(source, SourceFlags().keywords())
    begin = time.perf_counter()
    single = map_sequence(sequence.open(), config).map
    single_seconds = time.perf_counter() - begin
    single_mb = single.statistics().memory_mb
    folder = experiment.out / f"submaps_{voxel_size * 100:g}cm"
    shutil.rmtree(folder, ignore_errors=True)
    tasks, path = folder / "submaps", folder / "map.zarr"
    tasks.mkdir(parents=True)
    runner = LocalProcesses(JOBS)
    rounds: list[Result] = []
    for round in range(ROUNDS + 1):
        experiment.report(f"{voxel_size * 100:g} cm, round {round}", round, ROUNDS + 1)
        # Each call goes on where the last one has ended, as --resume does.
        result = map_in_submaps(
            sequence, config, SUBMAP_M, tasks, path, runner,
            rounds=round, settled=-1.0, resume=True, infer=infer_or_be_killed,
        )  # fmt: skip
        rounds.append(_compared(str(round), single, result, path))
    apart = folder / "apart"
    apart.mkdir()
    without_overlap(result.job).write(apart)
    parts = map_in_submaps(
        sequence, config, SUBMAP_M, apart, folder / "apart.zarr", runner, rounds=0, resume=True
    )
    rounds.append(_compared(APART, single, parts, folder / "apart.zarr"))
    killed = KilledOnce(tasks).note
    return {
        "rounds": rounds,
        "killed": killed.read_text(encoding="utf-8").strip() if killed.exists() else None,
        "submaps": len(result.job.plan.submaps),
        "keyframes": len(result.job.centres_m),
        "overlap": result.job.plan.overlap,
        "single_seconds": single_seconds,
        "single_mb": single_mb,
        "largest_task_mb": max(report.map_mb for report in result.rounds[-1].submaps),
        "largest_task_keyframes": max(report.keyframes for report in result.rounds[-1].submaps),
        "task_seconds": [sum(r.seconds for r in each.submaps) for each in result.rounds],
        "sweeps": config.inference.sweeps,
        "cost": asdict(_cost(config, result, single, path)),
    }


def without_overlap(job: Job) -> Job:
    """The job, but for each keyframe being in the submap alone where its camera was: what cutting a
    sequence into pieces would be."""
    side = job.plan.chunks_across * CHUNK_VOXELS * job.config.voxel_size
    home = {i: (math.floor(x / side), math.floor(y / side)) for i, (x, y, _) in job.centres_m.items()}
    submaps = [
        Submap(submap.cell, tuple(i for i in submap.keyframes if home[i] == submap.cell))
        for submap in job.plan.submaps
    ]
    return replace(job, plan=Plan(job.plan.chunks_across, tuple(s for s in submaps if s.keyframes)))


def _compared(name: str, single: OccupancyMap, result: SubmapsResult, path: Path) -> Result:
    last = result.rounds[-1]
    found = {"round": name, "seconds": last.seconds, "moved": last.moved, "halo_moved": last.halo_moved}
    return found | asdict(compare(single, ChunkedMap.open(path)))


def _settled_after(result: SubmapsResult) -> int:
    """How many times all submaps are inferred when they stop as soon as they have settled."""
    still = (r.round for r in result.rounds if r.moved is not None and r.moved <= SETTLED)
    return next(still, len(result.rounds) - 1) + 1


def _cost(config: Config, result: SubmapsResult, single: OccupancyMap, path: Path) -> MeasuredCost:
    """Cost of a keyframe of a real camera, and time and memory of the corridor's map."""
    source = f"{NAME}?rooms=2&frames={FULL_FRAMES}&width={FULL_WIDTH}&height={FULL_HEIGHT}"
    dataset = SourceFrames(source, SourceFlags().keywords()).open()
    m = create_map(config, dataset.camera)
    assert has_messages(m)
    for index in range(len(dataset)):
        frame = dataset.read(index)
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
    m.infer(sweeps=1)  # compiled by now
    # Of the process, so that it does not depend on what else the machine does or on how many cores it has.
    begin = time.process_time()
    m.infer()
    seconds = (time.process_time() - begin) / len(m.keyframes)
    size = single.statistics()
    keyframe_bytes = sum(k.voxel_bytes + k.image_bytes for k in m.keyframes.values()) / len(m.keyframes)
    area = 2 * HALF_WIDTH * corridor_length(ROOMS) + ROOMS * LENGTH * ROOM_WIDTH  # without walls
    stored = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return MeasuredCost(
        voxel_size=config.voxel_size,
        seconds=seconds,
        keyframe_mb=keyframe_bytes / 1e6,
        overlap=result.job.plan.overlap,
        rounds=_settled_after(result),
        submap_m=result.job.plan.chunks_across * CHUNK_VOXELS * config.voxel_size,
        keyframes_per_m2=len(result.job.centres_m) / area,
        voxels_per_m2=size.voxels / area,
        memory_bytes_per_voxel=BYTES_PER_VOXEL,
        store_bytes_per_voxel=stored / size.voxels,
    )


def _rows(voxel_size: float, result: Result) -> list[list[Entry]]:
    return [
        [
            f"{voxel_size * 100:g} cm",
            each["round"],
            100 * each["within"],
            100 * each["known_within"],
            100 * each["same_state"],
            each["largest"],
            _percent(each["moved"]),
            _percent(each["halo_moved"]),
            each["seconds"],
        ]
        for each in result["rounds"]
    ]


def _note(voxel_size: float, result: Result) -> str:
    return (
        f"{voxel_size * 100:g} cm: {result['keyframes']} keyframes in {result['submaps']} submaps, "
        f"{result['overlap']:.2f} each, {result['sweeps']} sweeps; killed: {result['killed'] or 'nobody'}; "
        f"memory {result['single_mb']:.0f} MB in one map, {result['largest_task_mb']:.0f} MB in the largest "
        f"task; {result['rounds'][-1]['voxels'] / 1e6:.2f} million voxels"
    )


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
