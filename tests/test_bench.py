"""The benchmark runs, and measures what it says."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import small_room

from taichi_mrf.config import Config
from taichi_mrf.evaluation.bench import bench_mapping, octomap_available


def test_the_figures_are_of_the_map_that_was_made(backend: str) -> None:
    frames = small_room.frames()[:3]
    done: list[int] = []
    row = bench_mapping(frames, Config(voxel_size=small_room.VOXEL_SIZE), False, done.append)
    m = small_room.build([0, 1, 2])
    assert done == [1, 2, 3]
    assert row.keyframes == 3
    assert row.bricks == m.statistics().bricks
    assert row.rays == sum(k.rays for k in m.keyframes.values()) // 3
    assert row.octomap is None
    assert row.ratio is None
    assert row.add >= row.sweeps > 0
    # A ray through the room crosses a few to a few dozen voxels of bricks near surfaces.
    assert 2 * row.rays < row.voxel_steps < 100 * row.rays


def test_the_command_writes_its_figures(tmp_path: Path) -> None:
    out = tmp_path / "bench.json"
    command = ["bench", "synthetic:room?width=64&height=48", "--voxel-sizes", "0.1", "--frames", "2"]
    done = subprocess.run(
        [sys.executable, "-m", "taichi_mrf", *command, "--runtime.arch", "cpu", "--json", str(out)],
        capture_output=True,
        text=True,
        check=True,
    )
    (row,) = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert row["voxel_size"] == 0.1
    assert "10 cm" in done.stdout
    if octomap_available():
        assert row["ratio"] == pytest.approx(row["add"] / row["octomap"])
    else:
        assert row["ratio"] is None
        assert "taichi-mrf[bench]" in done.stdout
