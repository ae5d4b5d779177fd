"""A run that is killed, or for which memory or disk is too small, loses as little as can be and says so."""

import json
import random
import shutil
import subprocess
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import small_room
from console import taichi_mrf
from killed_runs import OPTIONS, SOURCE, Run, disturbed, keyframes_of
from new_interpreter import python
from sliding_camera import ALL_FRAMES, CAMERA, SlidingCamera, StopAfter, names, sequence

from taichi_mrf.cli.map.keep import Keeper, resumed_map
from taichi_mrf.config.schema import Config, VolumeConfig
from taichi_mrf.errors import CapacityError, ConfigError, DatasetError
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.atomic import atomic_path, remove_leftovers
from taichi_mrf.system.memory import left_in_group

pytestmark = pytest.mark.usefixtures("one_backend")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, int]:
    """A run from its beginning to its end, and in how many steps."""
    run = Run(tmp_path_factory.mktemp("undisturbed") / "out")
    return run, len(run.go())


def test_a_run_that_is_killed_and_resumed_leaves_what_an_undisturbed_one_leaves(
    tmp_path: Path, undisturbed: tuple[Run, int]
) -> None:
    whole, steps = undisturbed
    run = disturbed(tmp_path / "out", random.Random(3), steps)
    assert run.kills
    assert run.digests() == whole.digests()


@pytest.mark.soak
@pytest.mark.parametrize(
    "options",
    [
        ("--method", "mrf"),
        ("--method", "log_odds"),
        ("--method", "visibility"),
        ("--refine-poses", "--inference.sweeps", "2"),
    ],
)
def test_runs_of_every_kind_that_are_killed_leave_what_undisturbed_ones_leave(
    options: tuple[str, ...], tmp_path: Path
) -> None:
    whole = Run(tmp_path / "whole", options)
    steps = len(whole.go())
    for seed in range(5):
        run = disturbed(tmp_path / f"run {seed}", random.Random(seed), steps, options)
        assert run.digests() == whole.digests(), f"seed {seed}: {run.kills}"


def test_what_does_not_fit_into_memory_is_named_and_the_rest_is_kept(
    tmp_path: Path, undisturbed: tuple[Run, int]
) -> None:
    out = tmp_path / "out"

    def run(*options: str) -> subprocess.CompletedProcess[str]:
        return taichi_mrf("map", SOURCE, "--out", out, *OPTIONS, *options)

    done = run("--volume.memory-limit-gb", "0.001")
    assert done.returncode == 3, done.stderr
    assert done.stderr.count("\n") == 1
    assert "does not fit: " in done.stderr
    assert f"keyframes was saved to {out}; --resume continues it" in done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["interrupted"] is True
    assert report["did_not_fit"] in done.stderr
    assert 0 < report["keyframes"] == keyframes_of(out) < 9
    assert report["sweeps"] == 3
    assert run("--resume", "--volume.memory-limit-gb", "1").returncode == 0
    whole = undisturbed[0].folder
    assert (out / "voxels.ply").read_bytes() == (whole / "voxels.ply").read_bytes()


def test_a_map_that_is_full_is_inferred_and_can_be_gone_on_with(tmp_path: Path) -> None:
    whole = map_sequence(sequence(), ALL_FRAMES)
    small = replace(ALL_FRAMES, volume=VolumeConfig(memory_limit_gb=4.5e-5))
    part = map_sequence(sequence(), small)
    assert part.full is not None
    assert f"frame frame {len(part.map.keyframes)} does not fit" in part.full
    assert 0 < len(part.map.keyframes) < 6
    part.map.save(tmp_path / "map.npz")
    larger = MRFMap.load(tmp_path / "map.npz", memory_limit_gb=0.0)
    again = map_sequence(sequence(), ALL_FRAMES, resume_from=larger)
    assert again.full is None
    again.map.save(tmp_path / "again.npz")
    whole.map.save(tmp_path / "whole.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_a_first_frame_that_does_not_fit_is_an_error() -> None:
    tiny = replace(ALL_FRAMES, volume=VolumeConfig(memory_limit_gb=1e-6))
    with pytest.raises(CapacityError):
        map_sequence(sequence(), tiny)


def test_the_limit_counts_images_and_messages_too() -> None:
    said: list[str] = []

    def mapped(limit_gb: float) -> int:
        m = MRFMap(small_room.VOXEL_SIZE, volume=VolumeConfig(memory_limit_gb=limit_gb))
        count = 0
        for frame in small_room.frames():
            try:
                small_room.add(m, frame)
            except CapacityError as error:
                said.append(str(error))
                break
            count += 1
        m.infer()
        voxels = m.statistics().bricks * 512 * 4
        held = voxels + sum(k.image_bytes + 2 * k.messages.shape[0] for k in m.keyframes.values())
        assert held < 1.1e9 * limit_gb
        assert len(m.keyframes) == count
        return count

    assert 0 < mapped(0.0013) < mapped(0.0021) < 10
    assert "keyframes with their messages would need" in said[0]


class FartherWall(SlidingCamera):
    """Other frames of the same names."""

    def read(self, index: int) -> Frame:
        frame = super().read(index)
        return replace(frame, depth_m=frame.depth_m + np.float32(0.25))


def kept(folder: Path, count: int, config: Config) -> MappingResult:
    """Files of a run that was stopped after some keyframes."""
    stop = StopAfter(Added, count)
    keeper = Keeper(folder, config, 0.0, lambda result: {"interrupted": True})
    return map_sequence(sequence(), config, stop.listen, should_stop=stop, keep=keeper)


def test_a_run_goes_on_with_what_it_kept_of_the_same_frames_and_parameters_only(tmp_path: Path) -> None:
    kept(tmp_path, 3, ALL_FRAMES)
    previous = resumed_map(tmp_path, ALL_FRAMES)
    assert previous is not None
    assert 0 < len(names(previous)) <= 3
    another = FartherWall("sliding", CAMERA)
    with pytest.raises(DatasetError, match=r"cannot resume: frame frame . of sliding differs"):
        map_sequence(another, ALL_FRAMES, resume_from=previous)
    other = replace(ALL_FRAMES, voxel_size=0.2)
    with pytest.raises(ConfigError, match=r"config\.yaml: made with another voxel_size"):
        resumed_map(tmp_path, other)
    (tmp_path / "config.yaml").unlink()
    with pytest.raises(ConfigError, match=r"map\.npz: made with another voxel_size"):
        resumed_map(tmp_path, other)


def test_what_cannot_be_kept_on_the_way_does_not_end_the_run(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path / "gone", ALL_FRAMES, 0.0, lambda result: {})
    with pytest.warns(UserWarning, match="the checkpoint could not be written: .*gone"):
        assert len(names(map_sequence(sequence(), ALL_FRAMES, keep=keeper).map)) == 6


def test_saving_takes_its_share_of_the_time_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("taichi_mrf.cli.map.keep.time.perf_counter", lambda: now)
    saved: list[float] = []

    class SlowMap:
        def save(self, path: Path) -> None:
            nonlocal now
            saved.append(now)
            now += 10.0

    result = MappingResult(SlowMap())  # type: ignore[arg-type]
    keeper = Keeper(tmp_path, Config(), 30.0, lambda result: {})
    while now < 1000.0:
        now += 1.0
        keeper(result)
    assert saved[0] == 30.0
    assert all(later - sooner >= 200.0 for sooner, later in pairwise(saved))
    assert len(saved) == 5


def test_half_written_files_of_the_dead_are_removed(tmp_path: Path) -> None:
    write = "from taichi_mrf.system.atomic import atomic_path\nimport os, sys\n"
    write += (
        "with atomic_path(sys.argv[1]) as path:\n    path.write_bytes(b'half')\n    os.kill(os.getpid(), 9)\n"
    )
    python("-c", write, tmp_path / "map.npz")
    (left,) = tmp_path.iterdir()
    (tmp_path / ".hidden.npz").write_bytes(b"")
    with atomic_path(tmp_path / "mine.npz") as alive:
        alive.write_bytes(b"x")
        remove_leftovers(tmp_path)
        assert alive.exists()
    assert not left.exists()
    assert {path.name for path in tmp_path.iterdir()} == {".hidden.npz", "mine.npz"}


def test_a_container_has_what_its_group_has_left(tmp_path: Path) -> None:
    for name, text in (("memory.max", "1000000"), ("memory.current", "900000")):
        (tmp_path / name).write_text(text)
    (tmp_path / "memory.stat").write_text("anon 5\ninactive_file 50000\n")
    assert left_in_group(tmp_path) == 150_000
    (tmp_path / "memory.max").write_text("max\n")
    assert left_in_group(tmp_path) is None
    shutil.rmtree(tmp_path)
    assert left_in_group(tmp_path) is None
