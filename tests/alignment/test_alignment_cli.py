"""``taichi-mrf map --refine-poses`` as a person runs it, on poses that were disturbed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from console import taichi_mrf
from inputs_frames import write_frames

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.datasets import open_dataset
from taichi_mrf.geometry.poses import tangent_norms
from taichi_mrf.system import runtime

FRAMES = 6


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """Six close views of the room as an npz, all but the first off by 2 cm and 1 degree; and the truth."""
    runtime.init("cpu")
    random = np.random.default_rng(0)
    frames = list(open_dataset("synthetic:room?frames=40&width=160&height=120"))[:FRAMES]
    true = np.stack([frame.T_world_camera for frame in frames])
    steps = random.normal(size=(FRAMES, 6)) * [0.02, 0.02, 0.02, *np.radians([1.0, 1.0, 1.0])]
    steps[0] = 0
    off = [replace(f, T_world_camera=moved(f.T_world_camera, s)) for f, s in zip(frames, steps, strict=True)]
    return write_frames(tmp_path / "walk.npz", off), true


def test_poses_come_nearer_to_the_true_ones_and_the_report_has_both(
    recording: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    path, true = recording
    out = tmp_path / "out"
    flags = ["--refine-poses", "--no-pictures", "--evaluation.hold-out", "0", "--keyframes.rotation", "0"]
    flags += ["--keyframes.translation", "0", "--runtime.arch", "cpu"]
    done = taichi_mrf("map", path, "--out", out, "--voxel-size", "0.1", "--json", *flags)
    assert done.returncode == 0, done.stderr
    poses = json.loads(done.stdout)["poses"]
    assert len(poses) == FRAMES
    assert poses[0]["moved_m"] == 0
    before = [tangent_norms(T, np.array(p["T_recorded"])) for T, p in zip(true, poses, strict=True)]
    after = [tangent_norms(T, np.array(p["T_refined"])) for T, p in zip(true, poses, strict=True)]
    assert np.sum(after, axis=0)[0] < 0.5 * np.sum(before, axis=0)[0]  # radians
    assert np.sum(after, axis=0)[1] < 0.5 * np.sum(before, axis=0)[1]  # metres


def test_maps_that_cannot_refine_say_so(recording: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    path, _ = recording
    flags = ("--refine-poses", "--method", "log_odds", "--runtime.arch", "cpu")
    done = taichi_mrf("map", path, "--out", tmp_path / "out", *flags)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "poses.refine" in done.stderr
