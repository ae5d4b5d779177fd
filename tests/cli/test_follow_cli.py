"""``--poses FILE`` and ``--follow`` on the command line."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_room
from console import FAST, assert_refused, carry_out, report_of, taichi_mrf
from datasets_recordings import stamped_line
from inputs_frames import write_frames
from live_program import wait_for

from taichi_mrf.cli.options.live import Live
from taichi_mrf.cli.options.shared import PoseFlags
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets.pose_sources.posed import PosedFrames
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.mapping import follow, pipeline
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.session.source import open_source

pytestmark = pytest.mark.usefixtures("one_backend")

COUNT = 4


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few frames of the small room, a second apart."""
    frames = [replace(frame, stamp=float(i)) for i, frame in enumerate(small_room.frames()[:COUNT])]
    return write_frames(tmp_path_factory.mktemp("recording") / "walk.npz", frames, stamped=True)


def write_poses(path: Path, offset_m: float) -> None:
    """A trajectory in TUM's layout that leaves the recorded one more and more."""
    lines = []
    for index, frame in enumerate(small_room.frames()[:COUNT]):
        T = frame.T_world_camera.copy()
        T[0, 3] += offset_m * index
        lines.append(stamped_line(float(index), T) + "\n")
    path.write_text("".join(lines))


def test_map_follows_a_file_and_makes_the_map_of_its_last_poses(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, out = tmp_path / "slam.txt", tmp_path / "followed"
    write_poses(poses, 0.2)
    flags = ("--poses", str(poses), *FAST, "--evaluation.hold-out", "0")
    for module in (follow, pipeline):
        monkeypatch.setattr(module, "FINAL_AFTER_S", 2.0)

    def close_the_loop() -> None:
        wait_for((out / "report.json").exists, "the first keyframe")
        write_poses(poses, 0.05)

    closing = threading.Thread(target=close_the_loop)
    closing.start()
    done = taichi_mrf("map", recording, "--out", out, *flags, "--follow", "--keep-every", "0")
    closing.join()
    assert done.returncode == 0, done.stderr
    report = report_of(out)
    assert report["followed"]["changes"] == 1
    assert (report["poses_from"], report["follow"]) == (str(poses), True)

    assert carry_out("map", recording, "--out", tmp_path / "once", *flags) == 0
    m, once = (load_map(folder / "map.npz") for folder in (out, tmp_path / "once"))
    np.testing.assert_array_equal(m.voxels(0.0)[0], once.voxels(0.0)[0])
    np.testing.assert_array_equal(m.voxels(0.0)[1], once.voxels(0.0)[1])
    assert f"poses of {COUNT} frames from {poses}" in report_of(tmp_path / "once")["notes"]
    # The same run again is the one that the folder holds; with the recorded poses it is another.
    assert carry_out("map", recording, "--out", tmp_path / "once", *flags, "--json") == 0
    with pytest.raises(ConfigError, match="another poses_from"):
        carry_out("map", recording, "--out", tmp_path / "once", *FAST, "--evaluation.hold-out", "0")


def test_live_opens_a_source_whose_poses_follow(recording: Path, tmp_path: Path) -> None:
    poses = tmp_path / "slam.txt"
    write_poses(poses, 0.1)
    live = Live(str(recording), poses=PoseFlags(file=str(poses), follow=True))
    keywords = {"every": 1, "limit": None, "speed": 0.0, "loop": False}
    flags = live.poses
    source, _ = open_source(live.source, Config(), poses=flags.file, follow=flags.follow, **keywords)
    assert isinstance(source.dataset, PosedFrames)
    assert source.dataset.follows
    for index, frame in enumerate(small_room.frames()[:COUNT]):
        x = source.dataset.read(index).T_world_camera[0, 3]
        assert x - frame.T_world_camera[0, 3] == pytest.approx(0.1 * index)
    assert source.choice["poses_from"] == str(poses)
    m = tmp_path / "map.npz"
    MRFMap(0.1).save(m)
    with pytest.raises(ConfigError, match=r"map.npz: is a saved map"):
        open_source(str(m), Config(), poses=flags.file, **keywords)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--follow",), ("--follow needs the file", "--poses FILE")),
        (("--poses", "p.txt", "--track-poses"), ("--poses and --track-poses",)),
        (("--poses", "p.txt", "--follow", "--refine-poses"), ("--follow and --refine-poses",)),
        (("--poses", "missing.txt"), ("missing.txt", "no such file")),
        (("--poses", "p.txt", "--submap-size", "3"), ("--poses takes one SOURCE",)),
    ],
)
def test_what_does_not_go_together_is_refused(
    recording: Path, tmp_path: Path, flags: tuple[str, ...], words: tuple[str, ...]
) -> None:
    assert_refused(taichi_mrf("map", recording, "--out", tmp_path / "run", *FAST, *flags), *words)


def test_a_broken_file_is_named_with_its_line(recording: Path, tmp_path: Path) -> None:
    poses = tmp_path / "slam.txt"
    poses.write_text("0 0 0 0 0 0 0 1\n1 0 0\n")
    with pytest.raises(DatasetError, match=r"slam.txt line 2: 3 numbers, expected 8"):
        carry_out("map", recording, "--out", tmp_path / "run", "--poses", poses, *FAST)
