"""The benchmark of queries asks the same of the same map, and says who is missing."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import small_room

from benchmarks.speed import queries
from benchmarks.speed.__main__ import main
from taichi_mrf import ExportOptions, cast_rays, export_map
from taichi_mrf.config.schema import Config
from taichi_mrf.evaluation.keyframe_cost import Seconds

NAMES = {"occupancy", "state", "distance", "distance and gradient", "balls", "rays", "rays of an image"}
CALLS = {"states", "distances", "rays", "rays that the unknown stops"}


@pytest.mark.usefixtures("backend")
def test_all_queries_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("POINTS", "RAYS", "BODIES", "ASKED"):
        monkeypatch.setattr(queries, name, 60)
    done: list[int] = []
    frame = small_room.frames()[2]
    row = queries.bench_queries(small_room.frames()[:3], Config(voxel_size=0.1), done.append)
    assert done == [1, 2, 3]
    assert set(row.rates) == NAMES
    assert {name: rate.count for name, rate in row.rates.items() if rate.count != 60} == {
        "balls": 3000,
        "rays of an image": frame.depth_m.size,
    }
    assert all(rate.seconds.wall > 0 for rate in (*row.rates.values(), *row.peers.values()))
    assert 0 < row.changed < row.box_voxels * 8
    missing = queries.missing_peers()
    peers = {"OctoMap": "OctoMap's search", "Open3D": "Open3D's rays"}
    assert set(row.peers) == {title for name, title in peers.items() if name not in missing}
    octomap = {
        "OctoMap's search",
        "OctoMap's rays",
        "OctoMap's rays that the unknown stops",
        "OctoMap's distances",
    }
    assert set(row.calls) == CALLS | (set() if "OctoMap" in missing else octomap)
    assert all(seconds.wall > 0 for call in row.calls.values() for seconds in call)
    figures = json.loads(json.dumps(row.to_json()))
    assert figures["rates"]["rays"]["millions"] == pytest.approx(row.rates["rays"].millions)
    assert [table.row_count for table in queries.query_tables([row], "a room")] == [
        7 + len(row.peers),
        len(row.calls),
        6,
    ]


def test_rates_are_counts_by_seconds() -> None:
    rate = queries.Rate(3_000_000, Seconds(wall=1.5, cpu=3.0))
    assert (rate.millions, rate.cpu_millions) == (2.0, 1.0)


@pytest.mark.usefixtures("one_backend")
def test_the_command_says_who_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("POINTS", "RAYS", "BODIES", "ASKED"):
        monkeypatch.setattr(queries, name, 60)
    out = tmp_path / "queries.json"
    command = ["speed", "synthetic:room?width=64&height=48&frames=3", "--measure", "queries"]
    command += ["--voxel-sizes", "0.2", "--runtime.arch", "cpu", "--json", str(out)]
    monkeypatch.setattr(sys, "argv", command)
    assert main() == 0
    said = capsys.readouterr().out
    report = json.loads(out.read_text(encoding="utf-8"))
    assert report["measured"] == "queries"
    assert set(report["rows"][0]["rates"]) == NAMES
    assert "distance and gradient" in said
    for name in ("OctoMap", "Open3D"):
        line = f"{name} is left out: pip install 'taichi-mrf[bench]' adds it."
        assert (line in said) == (name in queries.missing_peers())


@pytest.mark.usefixtures("one_backend")
def test_octomap_is_asked_about_the_same_map() -> None:
    pytest.importorskip("pyoctomap", reason="OctoMap is not installed: pip install 'taichi-mrf[octomap]'")
    m = small_room.build([0, 1, 2])
    points = np.random.default_rng(0).uniform(*queries._extent(m), (2000, 3))
    tree = queries.octree_of(m)
    labels = np.asarray(tree.getLabels(points))
    np.testing.assert_array_equal(labels, m.state(points).astype(int) - 1)
    assert len(np.unique(labels)) == 3
    # A ray through a corner of voxels may pass it on either side, and ranges end at a face or at a centre.
    free = points[labels == 0]
    ways = np.random.default_rng(1).normal(size=free.shape)
    for unknown, stop in (("free", False), ("stop", True)):
        hit = np.array(queries.octomap_rays(tree, free, ways, stop=stop))
        ours = cast_rays(m, free, ways, queries.RANGE_M, unknown).hit
        assert 0.1 < ours.mean() < 0.9
        assert (hit == ours).mean() > 0.97


@pytest.mark.usefixtures("one_backend")
def test_open3d_follows_rays_to_the_same_voxels(tmp_path: Path) -> None:
    pytest.importorskip("open3d", reason="Open3D is not installed: pip install 'taichi-mrf[bench]'")
    m = small_room.build([0, 1, 2])
    random = np.random.default_rng(1)
    starts = random.uniform(*queries._extent(m), (500, 3))
    ways = random.normal(size=starts.shape)
    free = m.state(starts) == 1
    export_map(m, tmp_path / "map.ply", ExportOptions(cubes=True, cells=False))
    found = queries._open3d_rays(tmp_path / "map.ply", starts[free], ways[free])()["t_hit"].numpy()
    ours = cast_rays(m, starts[free], ways[free], 50.0)
    agree = np.where(ours.hit, np.abs(ours.range - found) < 1e-3, np.isinf(found))
    assert ours.hit.any()
    assert agree.mean() > 0.99
