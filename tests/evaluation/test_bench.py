"""The benchmark runs, and measures what it says."""

import cProfile
import importlib
import json
import pstats
import sys
from pathlib import Path

import numpy as np
import pytest
import small_room
from console import taichi_mrf
from new_interpreter import python

from benchmarks.speed import profile
from benchmarks.speed.__main__ import main as speed_main
from benchmarks.speed.bandwidth import copy_bandwidth
from benchmarks.speed.growth import elsewhere, fit_line, measure_growth
from benchmarks.speed.profile import COPIES, FLOORS, Work, host_seconds
from taichi_mrf.cli import bench as bench_command
from taichi_mrf.cli.options.measure import Bench
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.bench import TARGETS, bench_mapping, octomap_available
from taichi_mrf.evaluation.keyframe_cost import Seconds, add_timed, live_stages
from taichi_mrf.methods.mrf.map import MRFMap

COARSE = Config(voxel_size=small_room.VOXEL_SIZE)
REPOSITORY = Path(__file__).resolve().parents[2]
TINY = "synthetic:room?width=64&height=48&frames=8"


def common(out: Path) -> list[str]:
    """Arguments of all measurements."""
    return [TINY, "--voxel-sizes", "0.1", "--frames", "4", "--runtime.arch", "cpu", "--json", str(out)]


def rows_of(out: Path) -> list[dict]:
    return json.loads(out.read_text(encoding="utf-8"))["rows"]


@pytest.mark.usefixtures("backend")
def test_the_figures_are_of_the_map_that_was_made() -> None:
    frames = small_room.frames()[:4]
    done: list[int] = []
    row = bench_mapping(frames, COARSE, False, done.append)
    m = small_room.build([0, 1, 2, 3])
    last = m.keyframes[3]
    assert done == [1, 2, 3, 4]
    assert (row.keyframes, row.steady) == (4, 1)
    assert row.bricks == m.statistics().bricks
    assert (row.pixels, row.rays) == (last.rays, last.ray_list.number)
    assert row.octomap is None
    assert row.ratio_alone is None
    # One keyframe is measured, so medians and sums are the same.
    assert row.alone.wall == pytest.approx(row.allocate.wall + row.own_sweep.wall)
    assert row.whole.wall == pytest.approx(row.alone.wall + row.reinference.wall)
    # A ray through the room crosses a few to a few dozen voxels of bricks near surfaces.
    assert 2 * row.rays < row.voxel_steps < 100 * row.rays


@pytest.mark.usefixtures("backend")
def test_a_keyframe_in_stages_leaves_the_map_that_a_live_run_leaves() -> None:
    in_stages, live = (MRFMap(small_room.VOXEL_SIZE, renew_tolerance=0.02) for _ in range(2))
    swept_again = 0
    for frame in small_room.frames()[:4]:
        swept_again += add_timed(in_stages, frame).swept_again
        live.renew([small_room.add(live, frame)])
    assert swept_again > 0
    points = small_room.probes()
    assert np.array_equal(in_stages.occupancy(points), live.occupancy(points))


def test_targets_are_those_of_the_usual_voxel_sizes() -> None:
    assert set(TARGETS) == set(Bench().voxel_sizes)
    assert all(alone < whole for alone, whole in TARGETS.values())


def test_a_picture_needs_a_known_ending() -> None:
    with pytest.raises(ConfigError, match=r"must end in \.png, \.svg or \.pdf"):
        Bench(plot=Path("stages.jpeg2"))


def test_the_command_writes_its_figures(tmp_path: Path) -> None:
    out = tmp_path / "bench.json"
    done = taichi_mrf("bench", *common(out), "--plot", tmp_path / "a.png")
    assert done.returncode == 0, done.stderr
    (row,), text = rows_of(out), done.stdout
    assert row["voxel_size"] == 0.1
    assert "10 cm" in text
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    if octomap_available():
        assert row["ratio_whole"] == pytest.approx(row["whole"]["wall"] / row["octomap"]["wall"])
        assert row["ratio_alone"] == pytest.approx(row["alone"]["wall"] / row["octomap"]["wall"])
        assert row["cpu_ratio_whole"] == pytest.approx(row["whole"]["cpu"] / row["octomap"]["cpu"])
        assert row["cpu_ratio_alone"] == pytest.approx(row["alone"]["cpu"] / row["octomap"]["cpu"])
    else:
        assert row["ratio_whole"] is None
        assert "taichi-mrf[bench]" in text


def test_the_gate_closes_when_a_ratio_has_grown(tmp_path: Path) -> None:
    if not octomap_available():
        pytest.skip("OctoMap is not installed: pip install 'taichi-mrf[bench]'")
    options = Bench(source=TINY, voxel_sizes=(0.1,))
    before, rows = (
        tmp_path / "before.json",
        [{"voxel_size": 0.1, "cpu_ratio_alone": 0.2, "cpu_ratio_whole": 0.3}],
    )
    before.write_text(json.dumps({"source": TINY, "rows": rows}))
    allowed = bench_command._ratios_in(before, options)
    assert bench_command._worse(rows, allowed) == []
    slower = [{"voxel_size": 0.1, "cpu_ratio_alone": 0.21, "cpu_ratio_whole": 0.34}]
    (line,) = bench_command._worse(slower, allowed)
    assert line == "0.1 m: a keyframe takes 0.340 of OctoMap's CPU time, 0.300 before"
    with pytest.raises(ConfigError, match=r"for voxels of 0\.05 0\.1 m"):
        bench_command._ratios_in(before, Bench(source=TINY, voxel_sizes=(0.05, 0.1)))
    with pytest.raises(ConfigError, match=r"was measured on .*room.*, not on kitchen"):
        bench_command._ratios_in(before, Bench(source="kitchen", voxel_sizes=(0.1,)))
    with pytest.raises(ConfigError, match="leave out --no-octomap"):
        Bench(gate=before, octomap=False)


def test_a_run_ends_with_what_the_gate_says(tmp_path: Path) -> None:
    if not octomap_available():
        pytest.skip("OctoMap is not installed: pip install 'taichi-mrf[bench]'")
    before = tmp_path / "before.json"
    tiny = {"voxel_size": 0.1, "cpu_ratio_alone": 1e-6, "cpu_ratio_whole": 1e9}
    before.write_text(json.dumps({"source": TINY, "rows": [tiny]}))
    command = ["bench", TINY, "--voxel-sizes", "0.1", "--frames", "2", "--gate", str(before)]
    done = taichi_mrf(*command, "--runtime.arch", "cpu")
    assert done.returncode == 1
    assert "a keyframe without re-inference takes" in done.stdout
    assert "0.000 before" in done.stdout


def test_every_kernel_with_a_floor_is_found_in_a_profile(tmp_path: Path) -> None:
    """In a process, which starts Taichi with its profiler."""
    out = tmp_path / "p.json"
    flags = ["--measure", "profile", *common(out), "--plot", str(tmp_path / "a.svg")]
    done = python("-m", "benchmarks.speed", *flags, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    (row,) = rows_of(out)
    found = {(kernel["stage"], kernel["name"]) for kernel in row["kernels"]}
    wanted = {(stage, name) for stage, floors in FLOORS.items() for name in floors if name not in COPIES}
    assert wanted <= found
    for stage, seconds in row["wall"].items():
        kernels = sum(kernel["seconds"] for kernel in row["kernels"] if kernel["stage"] == stage)
        assert 0 < kernels < seconds
    assert row["step_seconds"] > 0
    assert "send_messages" in done.stdout
    assert (tmp_path / "a.svg").exists()


@pytest.mark.usefixtures("backend")
def test_the_host_profile_leaves_nothing_out_and_counts_nothing_twice() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    for frame in small_room.frames()[:3]:
        for name, stage in live_stages(m, frame).items():
            watch = cProfile.Profile()
            watch.runcall(stage)
            total = pstats.Stats(watch).total_tt  # type: ignore[attr-defined]
            parts = sum(seconds for _, seconds in host_seconds(watch).values())
            assert parts == pytest.approx(total, rel=0.01), name


def test_what_a_library_calls_back_counts_once_and_its_own_time_is_its_callers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    package, library = tmp_path / "package", tmp_path / "elsewhere"
    package.mkdir()
    library.mkdir()
    (package / "ours.py").write_text(
        "from library import clock, twice\n"
        "def spend():\n    clock[0] += 100\n"
        "def short():\n    twice(spend, 1)\n"
        "def long():\n    twice(spend, 7)\n    clock[0] += 10\n"
    )
    (library / "library.py").write_text(
        "clock = [0]\n"
        "def twice(f, own):\n    f()\n    deeper(f, own)\n    clock[0] += own\n"
        "def deeper(f, own):\n    f()\n    clock[0] += own\n"
    )
    for folder in package, library:
        monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(profile, "PACKAGE", str(package))
    ours = importlib.import_module("ours")

    def run() -> None:
        ours.short()
        ours.long()
        ours.clock[0] += 5

    watch = cProfile.Profile(lambda: ours.clock[0], 1.0)
    watch.runcall(run)
    found = {name: seconds for name, (_, seconds) in host_seconds(watch).items()}
    # ``deeper``'s own 8 are shared as the callers of ``twice`` share its time: 202 and 214 of 416.
    assert found["ours: short"] == pytest.approx(1 + 8 * 202 / 416)
    assert found["ours: long"] == pytest.approx(10 + 7 + 8 * 214 / 416)
    assert found["ours: spend"] == 400
    assert found[profile.OTHERS] == 5
    assert sum(found.values()) == pytest.approx(pstats.Stats(watch).total_tt)  # type: ignore[attr-defined]


def test_floors_count_bytes() -> None:
    work = Work(
        pixels=100, rays=10, crossed=7, surface=5, created=3, visible=2, met=600, voxel_steps=50,
        message_bytes=2, trace_in_cache=True,
    )  # fmt: skip
    floors = FLOORS["own_sweep"]
    assert floors["cavity"](work) == 2 * 512 * (4 + 2 + 4 + 8)
    assert floors["finish"](work) == 2 * 512 * 8 + 600 * (2 + 2 + 4 + 4)
    assert floors["send_messages"](work) == 10 * 12 + 600 * 20
    assert FLOORS["allocate"]["fill_bricks"](work) == 3 * (4 + 512 * 4)


@pytest.mark.usefixtures("backend")
def test_memory_copies_at_some_speed() -> None:
    found = copy_bandwidth(1 << 22)
    assert 1e6 < found.bytes_per_second < 1e14
    assert "8 MB" in found.how


@pytest.mark.usefixtures("one_backend")
def test_laps_at_places_of_their_own_see_nothing_of_each_other() -> None:
    frames = small_room.frames()[:4]
    coarse = Config(voxel_size=0.16)
    unseen = measure_growth(frames, coarse, "unseen").laps
    seen = measure_growth(frames, coarse, "seen").laps
    alone = MRFMap(0.16)
    small_room.add(alone, elsewhere(frames[3], 3))  # bricks lie otherwise at each place
    bricks = alone.statistics().bricks
    assert [lap.old for lap in unseen] == [lap.old for lap in seen] == [0, 1, 2, 3]
    assert unseen[3].bricks - unseen[2].bricks == bricks
    assert seen[3].bricks - seen[2].bricks < bricks


@pytest.mark.usefixtures("one_backend")
def test_places_are_a_hundred_metres_apart() -> None:
    frame = small_room.frames()[0]
    origins = np.array([elsewhere(frame, place).T_world_camera[:3, 3] for place in range(9)])
    apart = np.linalg.norm(origins[:, None] - origins[None], axis=2)[~np.eye(9, dtype=bool)]
    assert apart.min() == pytest.approx(100.0)


def test_a_line_is_fitted_with_its_error() -> None:
    rng = np.random.default_rng(1)
    x = np.arange(400.0)
    line = fit_line(x, 3.0 + 0.5 * x + rng.normal(0.0, 2.0, 400))
    # The error of a slope is sigma / sqrt(sum of squared distances from the mean).
    expected = 2.0 / np.sqrt(((x - x.mean()) ** 2).sum())
    assert line.slope_error == pytest.approx(expected, rel=0.15)
    assert abs(line.slope - 0.5) < 4 * expected
    assert line.at(100.0) == pytest.approx(53.0, abs=1.0)
    assert fit_line([1.0], [2.0]).slope_error is None


@pytest.mark.usefixtures("one_backend")
def test_growth_is_measured_and_drawn_by_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "g.json"
    flags = ["--measure", "growth", *common(out), "--plot", str(tmp_path / "g.png")]
    monkeypatch.setattr(sys, "argv", ["speed", *flags])
    assert speed_main() == 0
    rows = rows_of(out)
    assert [row["kind"] for row in rows] == ["unseen", "seen"]
    assert all(np.isfinite(row["lines"]["whole"]["slope"]) for row in rows)
    assert "unseen" in capsys.readouterr().out
    assert (tmp_path / "g.png").exists()


def test_medians_are_of_each_clock() -> None:
    assert Seconds.median([Seconds(1, 9), Seconds(2, 8), Seconds(3, 7)]) == Seconds(2, 8)
    assert Seconds(1, 2) + Seconds(3, 4) == Seconds(4, 6)
