"""Submaps: every brick has one owner, what is told is what should be, and the merged map is the map."""

import io
import json
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from in_process import InProcess
from scipy.spatial import KDTree
from small_room import VOXEL_SIZE, add, frames

from benchmarks.lab.submaps.equality import KilledOnce, compare, infer_or_be_killed
from taichi_mrf.cluster.local import LocalProcesses
from taichi_mrf.cluster.submaps.partial_map import PartialMap
from taichi_mrf.cluster.submaps.plan import Job, Plan, SeenFrame, SourceFrames, chunks_for, plan_submaps
from taichi_mrf.cluster.submaps.round_files import read_core, read_report, round_path
from taichi_mrf.cluster.submaps.rounds import SubmapsResult, map_in_submaps
from taichi_mrf.cluster.submaps.task import share_moved
from taichi_mrf.config.schema import Config, EvaluationConfig, PoseConfig, RuntimeConfig, VolumeConfig
from taichi_mrf.config.sections import InferenceConfig, TimeConfig
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError, DatasetError, MapFileError
from taichi_mrf.export.fused_surface import FusedSurface
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import take_part
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.voxels.layers import LOG_ODDS
from taichi_mrf.voxels.layout import CHUNK

zarr = pytest.importorskip("zarr", reason="maps in chunks need the extra store")

SOURCE = "synthetic:corridor?rooms=2&frames=24&width=80&height=60"
SEQUENCE = SourceFrames(SOURCE, SourceFlags().keywords())
CONFIG = Config(
    0.1,
    inference=InferenceConfig(outlier_floor=1e-6),  # set, so that no recording's own takes its place
    evaluation=EvaluationConfig(hold_out=0),
    color=True,
    keep_surface=True,
)
VOXEL_M, SUBMAP_M = 0.1, 12.8

chunk = st.tuples(*[st.integers(-9, 9)] * 3)
seen = st.lists(st.sets(chunk, min_size=1, max_size=6), min_size=1, max_size=8)


def planned(views: list[set[tuple[int, int, int]]]) -> list[SeenFrame]:
    return [SeenFrame(3 * i, (0.0, 0.0, 0.0), np.array(sorted(v), np.int32)) for i, v in enumerate(views)]


@given(seen, st.integers(1, 4))
def test_each_brick_has_one_owner_which_has_all_who_see_it(
    views: list[set[tuple[int, int, int]]], across: int
) -> None:
    plan = plan_submaps(planned(views), across * 6.4, 0.1)
    assert plan.chunks_across == across
    random = np.random.default_rng(0)
    for number, view in enumerate(views):
        for place in view:
            bricks = np.array(place) * CHUNK + random.integers(0, CHUNK, (3, 3)).astype(np.int32)
            owners = [n for n in range(len(plan.submaps)) if plan.is_core(n, bricks).any()]
            assert len(owners) == 1
            assert plan.is_core(owners[0], bricks).all()
            assert 3 * number in plan.submaps[owners[0]].keyframes
    for number, submap in enumerate(plan.submaps):
        for other, common in plan.neighbours(number).items():
            assert plan.neighbours(other)[number] == common
            assert set(common) == set(submap.keyframes) & set(plan.submaps[other].keyframes)
    assert plan_submaps(planned(views)[::-1], across * 6.4, 0.1) == plan


def test_a_column_is_a_whole_number_of_chunks() -> None:
    assert [chunks_for(size, 0.1) for size in (0.5, 6.4, 6.41, 12.8)] == [1, 1, 2, 2]
    assert chunks_for(3 * 64 * 0.05, 0.05) == 3
    for size in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="submap-size"):
            chunks_for(size, 0.1)


def partial(chosen: list[int]) -> PartialMap:
    m = PartialMap(VOXEL_SIZE)
    for i in chosen:
        add(m, frames()[i])
    return m


def test_evidence_of_absent_keyframes_counts_as_frozen_ones_do(one_backend: str) -> None:
    together = partial([0, 1, 2])
    together.infer()
    for id in (0, 1):
        together.freeze_keyframe(id)
    bricks = together.bricks()
    evidence = together._pool.read("evidence", together._registry.topology.slots(bricks))
    together.infer()
    alone = partial([2])
    assert len(alone.bricks()) < len(bricks)
    alone.assume(bricks, evidence)
    alone.infer()
    np.testing.assert_array_equal(alone.bricks(), bricks)
    np.testing.assert_array_equal(alone.beliefs(bricks), together.beliefs(bricks))


def test_what_is_told_leaves_out_what_the_listener_knows(one_backend: str) -> None:
    m = partial([0, 1, 2])
    m.infer()
    told = m.beliefs(m.bricks(), without=[1])
    before, bricks = m.beliefs(m.bricks()), m.bricks()
    m.remove_keyframe(1)
    left = np.isin(bricks.view("i4,i4,i4").ravel(), m.bricks().view("i4,i4,i4").ravel())
    np.testing.assert_array_equal(told[left], m.beliefs(bricks[left]))
    assert (before[left] != told[left]).any()
    # A brick that only keyframe 1 wanted holds what the others say all the same.
    assert left.mean() < 1


def test_the_robots_own_body_is_read_back(tmp_path: Path) -> None:
    body = OwnBody(mask="body.png", body_box=((0.0, -0.1, 0.0, 0.5, 0.1, 0.4),), body_margin=0.03)
    job = Job(SourceFrames(SOURCE, {"body": body}), CONFIG, SUBMAP_M, Plan(2, ()), {}, {})
    job.write(tmp_path)
    assert Job.read(tmp_path).sequence == job.sequence


@cache
def single_map() -> MRFMap:
    m = map_sequence(SEQUENCE.open(color=True), CONFIG).map
    assert isinstance(m, MRFMap)
    return m


def mapped(folder: Path, rounds: int, **options: object) -> SubmapsResult:
    runner = options.pop("runner", InProcess())
    return map_in_submaps(
        SEQUENCE, CONFIG, SUBMAP_M, folder / "submaps", folder / "map.zarr", runner,  # type: ignore[arg-type]
        rounds=rounds, settled=-1.0, **options,  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.fixture(scope="module")
def exchanged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of two rounds, its map after the first in before.zarr."""
    from taichi_mrf.system import runtime

    runtime.init()
    folder = tmp_path_factory.mktemp("exchanged")
    mapped(folder, 0)
    (folder / "map.zarr").rename(folder / "before.zarr")
    mapped(folder, 1, resume=True)
    return folder


def test_the_merged_map_is_that_of_a_single_machine(exchanged: Path) -> None:
    first = compare(single_map(), ChunkedMap.open(exchanged / "before.zarr"))
    second = compare(single_map(), ChunkedMap.open(exchanged / "map.zarr"))
    assert second.voxels == single_map().statistics().voxels
    assert second.known > 50_000
    assert second.within >= 0.995
    assert second.known_within >= 0.995
    assert second.same_state >= 0.995
    assert second.within > first.within or first.largest > second.largest  # what is exchanged matters
    assert second.largest < first.largest


def test_colours_and_surface_are_those_of_a_single_machine(exchanged: Path) -> None:
    part, m = take_part(ChunkedMap.open(exchanged / "map.zarr")), single_map()
    centres = m.voxels(0.5)[0]
    ours, theirs = part.colors(centres).astype(int), m.colors(centres).astype(int)
    seen = theirs[:, 3] > 0
    assert seen.mean() > 0.8
    assert (np.abs(ours - theirs)[seen].max(axis=1) <= 3).mean() > 0.99
    surface, whole = part.surface(), m.surface()
    distance_m, nearest = KDTree(whole.vertices_m).query(surface.vertices_m)
    assert abs(len(surface.vertices_m) - len(whole.vertices_m)) < 0.005 * len(whole.vertices_m)
    assert (distance_m < 0.01 * VOXEL_M).mean() > 0.99
    np.testing.assert_allclose(surface.std_m, whole.std_m[nearest], rtol=0.05, atol=0.1 * VOXEL_M)
    # The surface goes on across the borders of columns: no more open edges are there than in the single map.
    assert abs(_open_edges_at_borders(surface) - _open_edges_at_borders(whole)) <= 4
    near = m.voxels(0.0)[0]
    read = ChunkedMap.open(exchanged / "map.zarr").decided.state(near)
    assert (read == m.decided.state(near)).mean() > 0.995
    vertices = {tuple(v) for v in surface.vertices_m}
    assert len(vertices) == len(surface.vertices_m)


def _open_edges_at_borders(surface: FusedSurface) -> int:
    """Edges with a triangle on one side only within two voxels of a border between columns."""
    edges = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    alone, count = np.unique(edges, axis=0, return_counts=True)
    middle = surface.vertices_m[alone[count == 1]].mean(axis=1)[:, :2]
    offset = np.abs(middle - np.rint(middle / SUBMAP_M) * SUBMAP_M)
    return int((offset < 2 * VOXEL_M).any(axis=1).sum())


def test_nothing_is_done_twice(exchanged: Path) -> None:
    files = {path: path.stat().st_mtime_ns for path in (exchanged / "submaps").rglob("*") if path.is_file()}
    result = mapped(exchanged, 1, resume=True)
    assert {path: path.stat().st_mtime_ns for path in files} == files
    assert [each.round for each in result.rounds] == [0, 1]
    assert result.rounds[0].moved is None
    assert result.rounds[1].moved is not None
    assert result.rounds[1].moved < 0.01


def test_a_damaged_round_is_named(exchanged: Path, tmp_path: Path) -> None:
    whole = round_path(exchanged / "submaps", 1, 0)
    content = whole.read_bytes()
    assert read_report(whole).submap == 0
    for name, damaged in (("short", content[: len(content) // 2]), ("flipped", flipped(content, "belief"))):
        path = tmp_path / name
        path.write_bytes(damaged)
        with pytest.raises(MapFileError, match=name):
            read_core(path)


def flipped(content: bytes, member: str) -> bytes:
    """A zip file with one bit of a member's values another."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        info = archive.getinfo(f"{member}.npy")
    place = info.header_offset + info.compress_size // 2 + 60
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


def test_what_moved_is_a_share_of_probabilities() -> None:
    before = np.array([[0.0, 0.0, -9.0, 9.0]], np.float32)
    now = np.array([[0.2, 0.0, -7.0, 7.0]], np.float32)  # only the first by more than 0.01 of probability
    assert share_moved([(now, before)]) == 0.25
    assert share_moved([(now, before), (before, before)]) == 0.125
    assert share_moved([]) == 0.0


def test_only_the_same_run_is_gone_on_with(exchanged: Path) -> None:
    sequence = SourceFrames(SOURCE.replace("24", "25"), SEQUENCE.reading)
    for other, config, size, named in (
        (sequence, CONFIG, SUBMAP_M, "source"),
        (SEQUENCE, Config(0.2, evaluation=CONFIG.evaluation), SUBMAP_M, "voxel_size"),
        (SEQUENCE, CONFIG, 6.4, "submap_size"),
    ):
        with pytest.raises(ConfigError, match=named):
            map_in_submaps(
                other, config, size, exchanged / "submaps", exchanged / "other.zarr", InProcess(),
                rounds=1, resume=True,
            )  # fmt: skip
    assert Job.read(exchanged / "submaps").differences(SEQUENCE, CONFIG, SUBMAP_M) == []


def test_what_cannot_be_cut_is_refused(tmp_path: Path) -> None:
    for config, problem in (
        (Config(0.1, method="log_odds"), "method mrf"),
        (Config(0.1, poses=PoseConfig(refine=True)), "poses.refine"),
        (Config(0.1, time=TimeConfig(half_life_s=600.0)), "time.half_life_s must be 0"),
    ):
        with pytest.raises(ConfigError, match=problem):
            map_in_submaps(SEQUENCE, config, 6.4, tmp_path / "s", tmp_path / "m.zarr", InProcess(), rounds=0)
    nothing = SourceFrames("synthetic:corridor?frames=3", SEQUENCE.reading, limit=1)
    with pytest.raises(DatasetError, match="no frame could be mapped"):
        map_in_submaps(
            nothing, Config(0.1, evaluation=EvaluationConfig(hold_out=0), keyframes=CONFIG.keyframes),
            6.4, tmp_path / "s", tmp_path / "m.zarr", _Blind(), rounds=0,
        )  # fmt: skip


def test_a_folder_that_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "submaps").mkdir()
    (tmp_path / "submaps" / "thesis.tex").write_text("years of work")
    with pytest.raises(MapFileError, match=r"submaps: holds thesis\.tex"):
        mapped(tmp_path, 0)
    assert (tmp_path / "submaps" / "thesis.tex").read_text() == "years of work"


def test_a_damaged_plan_is_named(exchanged: Path, tmp_path: Path) -> None:
    plan = json.loads((exchanged / "submaps" / "plan.json").read_text())
    for name, value in (("config", "[1"), ("centres_m", []), ("plan", {"submaps": 3}), ("sequence", "walk")):
        (tmp_path / "plan.json").write_text(json.dumps({**plan, name: value}))
        with pytest.raises(MapFileError, match=r"plan\.json: not a readable plan"):
            Job.read(tmp_path)


def test_fewer_rounds_than_there_were_are_refused(exchanged: Path, tmp_path: Path) -> None:
    shutil.copytree(exchanged / "submaps", tmp_path / "submaps")
    shutil.rmtree(tmp_path / "submaps" / "round-000")  # as round 2 does when it is through
    with pytest.raises(ConfigError, match="needs more --rounds"):
        mapped(tmp_path, 0, resume=True)


def test_memory_and_backend_may_be_others_when_a_run_is_resumed(exchanged: Path, tmp_path: Path) -> None:
    shutil.copytree(exchanged / "submaps", tmp_path / "submaps")
    config = replace(CONFIG, volume=VolumeConfig(memory_limit_gb=2.0), runtime=RuntimeConfig(threads=1))
    map_in_submaps(
        SEQUENCE, config, SUBMAP_M, tmp_path / "submaps", tmp_path / "map.zarr", InProcess(),
        rounds=1, resume=True,
    )  # fmt: skip
    assert Job.read(tmp_path / "submaps").config == config  # which is what tasks read


def test_a_store_without_its_list_of_chunks_is_named(exchanged: Path, tmp_path: Path) -> None:
    shutil.copytree(exchanged / "map.zarr", tmp_path / "map.zarr")
    shutil.rmtree(tmp_path / "map.zarr" / "chunks")
    with pytest.raises(MapFileError, match=r"chunks/zarr\.json: damaged: there is no such file"):
        ChunkedMap.open(tmp_path / "map.zarr")


class _Blind:
    """A runner whose survey finds nothing."""

    def run(self, function: object, tasks: object, done: object = None) -> list:
        return []


def test_a_killed_worker_changes_nothing(exchanged: Path, tmp_path: Path) -> None:
    """In the second round, which alone is made here. One process at a time: each finds the kernels that the
    first compiled, which two at once would both compile."""
    shutil.copytree(exchanged / "submaps", tmp_path / "submaps")
    shutil.rmtree(tmp_path / "submaps" / "round-001")
    (tmp_path / "submaps" / "round-001.json").unlink()
    result = mapped(tmp_path, 1, runner=LocalProcesses(), infer=infer_or_be_killed, resume=True)
    note = KilledOnce(tmp_path / "submaps").note
    assert "in round 1" in note.read_text()
    ours, theirs = ChunkedMap.open(tmp_path / "map.zarr"), ChunkedMap.open(exchanged / "map.zarr")
    np.testing.assert_array_equal(ours.chunks, theirs.chunks)
    for place in ours.chunks:
        np.testing.assert_array_equal(ours.store.read(LOG_ODDS, place), theirs.store.read(LOG_ODDS, place))
    assert len(result.rounds) == 2


def test_the_command(exchanged: Path, tmp_path: Path) -> None:
    """On what is there already: the command resumes, merges, draws and reports."""
    shutil.copytree(exchanged / "submaps", tmp_path / "submaps")
    flags = ["--voxel-size", "0.1", "--evaluation.hold-out", "0", "--color", "--keep-surface"]
    flags += ["--submap-size", "12.8", "--rounds", "1", "--inference.outlier-floor", "1e-6"]
    command = [sys.executable, "-m", "taichi_mrf", "map", SOURCE, "--out", str(tmp_path)]
    command += ["--resume", "--json"]
    done = subprocess.run([*command, *flags], capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    assert report == json.loads((tmp_path / "report.json").read_text())
    assert report["keyframes"] == 24
    assert len(report["rounds"]) == 2
    assert report["voxels"] == single_map().statistics().voxels
    assert {"map.zarr", "config.yaml", "submaps.png", "report.json"} <= {p.name for p in tmp_path.iterdir()}
    assert ChunkedMap.open(tmp_path / "map.zarr").config == CONFIG
    wrong = subprocess.run([*command, *flags[:-4], "--submap-size", "-1"], capture_output=True, text=True)
    assert wrong.returncode == 2
    assert "submap" in wrong.stderr
    assert wrong.stderr.count("\n") == 1
