"""``taichi-mrf map`` with a window: a map in chunks beside the map's file, and what goes with it."""

import json
from pathlib import Path

import numpy as np
import pytest
from console import COARSE, taichi_mrf

from taichi_mrf.cluster.submaps.rounds import _check
from taichi_mrf.config.schema import Config, EvaluationConfig, SensorConfig, VolumeConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import ConfigError
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.queries.points import UNKNOWN
from taichi_mrf.session.source import open_source

pytest.importorskip("zarr", reason="a window needs the extra store")
pytestmark = pytest.mark.usefixtures("one_backend")

CORRIDOR = "synthetic:corridor?rooms=4&frames=60&width=48&height=36"
NEAR = ("--sensor.max-depth", "3")


def test_a_run_with_a_window_leaves_the_whole_map_in_chunks(tmp_path: Path) -> None:
    done = taichi_mrf("map", CORRIDOR, "--out", tmp_path, *COARSE, *NEAR, "--volume.window-m", "3")
    assert done.returncode == 0, done.stderr
    assert "frozen outside of the window" in done.stdout
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["keyframes"] + report["frozen"] == 54
    assert report["accuracy"]["frames"] == 6
    assert report["accuracy"]["median_abs"] < 0.1
    assert "map_window.zarr holds its" in " ".join(report["notes"])
    # What free means is found by the held-out frames that see into the window.
    assert 3 <= report["free_space"]["blocks"] <= 6
    assert {path.name for path in tmp_path.iterdir()} == {
        "map.npz", "map_window.zarr", "voxels.ply", "config.yaml", "report.json",
    }  # fmt: skip
    whole, near = ChunkedMap.open(tmp_path / "map_window.zarr"), load_map(tmp_path / "map.npz")
    centres, _ = whole.voxels(min_probability=0.5)
    assert f"element vertex {len(centres)}" in (tmp_path / "voxels.ply").read_bytes()[:300].decode()
    assert (near.state(centres) == UNKNOWN).mean() > 0.2
    assert near.promise.blocks == report["free_space"]["blocks"]
    # What is said and exported of the map's file is of the whole map too.
    info = taichi_mrf("info", tmp_path / "map.npz").stdout
    assert f"{len(near.window.parked)} chunks, in map_window.zarr" in info
    exported = tmp_path / "exported.ply"
    assert taichi_mrf("export", tmp_path / "map.npz", "--to", exported, "--no-cells").returncode == 0
    assert f"element vertex {len(centres)}" in exported.read_bytes()[:500].decode("ascii", "replace")
    box = ("--lower", "0", "-1", "-1", "--upper", "1", "1", "1")
    assert taichi_mrf("export", tmp_path / "map.npz", "--to", exported, *box).returncode == 0
    assert f"element vertex {len(centres)}" not in exported.read_bytes()[:500].decode("ascii", "replace")
    same = taichi_mrf("diff", tmp_path / "map.npz", tmp_path / "map.npz", "--json")
    known = json.loads(same.stdout)
    assert (known["changed_state"], known["known_in_both"]) == (0, known["known_in_both"])
    assert known["known_in_both"] > 2 * (near.state(near.voxels(0.0)[0]) != UNKNOWN).sum()
    _, notes = open_source(str(tmp_path / "map.npz"), near.config, every=1, limit=None, speed=0.0, loop=False)
    assert any("map_window.zarr has all of it" in note for note in notes)
    # A run without a window that takes its place leaves no part of it.
    again = ("map", CORRIDOR, "--out", tmp_path, *COARSE, *NEAR, "--limit", "5", "--no-pictures")
    assert taichi_mrf(*again, "--overwrite").returncode == 0
    assert not (tmp_path / "map_window.zarr").exists()


def test_a_stopped_run_goes_on_with_its_chunks(tmp_path: Path) -> None:
    dataset = open_dataset(CORRIDOR, color=False)
    config = Config(
        0.1,
        sensor=SensorConfig(max_depth=3.0),
        volume=VolumeConfig(window_m=3.0),
        evaluation=EvaluationConfig(hold_out=0),
    )
    path, left = tmp_path / "map.npz", [40]

    def stop() -> bool:
        left[0] -= 1
        return left[0] < 0

    map_sequence(dataset, config, should_stop=stop, map_path=path).map.save(path)
    resumed = map_sequence(dataset, config, resume_from=load_map(path), map_path=path).map
    resumed.save(path)
    other = map_sequence(dataset, config, map_path=tmp_path / "other.npz").map
    other.save(tmp_path / "other.npz")
    statistics = resumed.statistics(), other.statistics()
    assert statistics[0].keyframes + statistics[0].frozen == statistics[1].keyframes + statistics[1].frozen
    ours, theirs = (ChunkedMap.open(tmp_path / f"{name}_window.zarr") for name in ("map", "other"))
    centres, p = theirs.voxels(min_probability=0.0)
    assert set(map(tuple, ours.chunks.tolist())) == set(map(tuple, theirs.chunks.tolist()))
    assert (ours.state(centres) == theirs.state(centres)).mean() > 0.97
    assert (np.abs(ours.occupancy(centres) - p) < 0.02).mean() > 0.9


def test_submaps_refuse_a_window() -> None:
    with pytest.raises(ConfigError, match=r"volume.window_m does not work with submaps"):
        _check(Config(volume=VolumeConfig(window_m=3.0)), 1)
