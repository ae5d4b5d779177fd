"""Maps in chunks: they answer as the map does that they were made from, and never hold more than they may."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from console import carry_out
from queried_maps import room_map

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.errors import ConfigError, MapFileError, TaichiMRFError
from taichi_mrf.export.chunk_blocks import write_chunks
from taichi_mrf.export.chunk_store import CHUNK_BYTES, ChunkStore, StoreHeader, new_store
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.inference.ray_model import Limits
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import take_part
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.queries.box import read_box
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import CHUNK_VOXELS

zarr = pytest.importorskip("zarr", reason="maps in chunks need the extra store")
pytestmark = pytest.mark.usefixtures("one_backend")

METHODS = ["mrf", "log_odds"]


@pytest.fixture(scope="module")
def stores(one_backend: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("stores")
    for method in METHODS:
        export_map(room_map(method), folder / f"{method}.zarr")
    return {method: folder / f"{method}.zarr" for method in METHODS}


def places(m: OccupancyMap, count: int = 60_000) -> np.ndarray:
    """Points in and around a map, and all centres of its voxels."""
    random = np.random.default_rng(0).uniform(-9, 9, (count, 3))
    return np.concatenate([random, m.voxels(0.0)[0][::7]])


@pytest.mark.parametrize("method", METHODS)
def test_it_answers_as_the_map_does(stores: dict[str, Path], method: str) -> None:
    m, chunked = room_map(method), ChunkedMap.open(stores[method])
    points = places(m)
    np.testing.assert_array_equal(chunked.state(points), m.state(points))
    near = m.voxels(0.0)[0][::7]
    ours, theirs = chunked.marginals, m.marginals
    np.testing.assert_array_equal(ours.occupancy(near), theirs.occupancy(near))
    np.testing.assert_allclose(ours.occupancy(points), theirs.occupancy(points), atol=1e-6)
    np.testing.assert_array_equal(chunked.occupancy(points) > 0.5, m.occupancy(points) > 0.5)
    assert chunked.voxel_size == m.voxel_size
    assert chunked.config == m.config
    assert len(chunked.chunks) > 4


def test_voxels_of_a_box_and_of_all(stores: dict[str, Path]) -> None:
    m, chunked = room_map("mrf").marginals, ChunkedMap.open(stores["mrf"]).marginals
    expected = {tuple(c) for c in np.round(m.voxels(0.6)[0], 6)}
    assert {tuple(c) for c in np.round(chunked.voxels(min_probability=0.6)[0], 6)} == expected
    lower, upper = np.array([-1.03, -0.52, -1.34]), np.array([2.03, 1.72, 0.41])
    centres, probability = chunked.voxels(lower, upper, 0.6)
    half = chunked.voxel_size / 2
    touched = {c for c in expected if ((np.array(c) + half > lower) & (np.array(c) - half < upper)).all()}
    assert {tuple(c) for c in np.round(centres, 6)} == touched
    assert 0 < len(centres) < len(expected)
    np.testing.assert_array_equal(probability, m.occupancy(centres))


def test_a_box_as_arrays(stores: dict[str, Path]) -> None:
    m, chunked = room_map("mrf"), ChunkedMap.open(stores["mrf"])
    lower, upper = (-1.0, -2.9, -1.5), (1.3, 0.4, 1.7)
    np.testing.assert_array_equal(chunked.box(lower, upper).state, read_box(m, lower, upper).state)
    ours, theirs = chunked.marginals.box(lower, upper), read_box(m.marginals, lower, upper)
    assert ours.lowest == theirs.lowest
    np.testing.assert_array_equal(ours.state, theirs.state)
    np.testing.assert_allclose(ours.occupancy, theirs.occupancy, atol=1e-6)


def test_no_more_chunks_are_held_than_the_cache_may(stores: dict[str, Path]) -> None:
    chunked = ChunkedMap.open(stores["mrf"], cache_mb=2.5 * CHUNK_BYTES / 1e6)
    points = places(room_map("mrf"))
    expected = ChunkedMap.open(stores["mrf"]).state(points)
    held = []
    for begin in range(0, len(points), 5000):
        piece = slice(begin, begin + 5000)
        np.testing.assert_array_equal(chunked.state(points[piece]), expected[piece])
        held.append(len(chunked.decided._cache))
    assert max(held) == 2 < len(chunked.chunks)
    with pytest.raises(ConfigError, match="cache_mb"):
        ChunkedMap.open(stores["mrf"], cache_mb=0.5)


def test_any_zarr_reader_can_read_it(stores: dict[str, Path]) -> None:
    group = zarr.open_group(str(stores["mrf"]), mode="r")
    array, origin = group["log_odds"], np.array(group.attrs["origin_m"])
    assert array.chunks == (CHUNK_VOXELS,) * 3
    assert array.nchunks_initialized == group["chunks"].shape[0]
    centres, probability = room_map("mrf").marginals.voxels(0.9)
    place = np.floor((centres - origin) / group.attrs["voxel_size"]).astype(int)
    log_odds = array[:][tuple(place.T)]
    np.testing.assert_allclose(1 / (1 + np.exp(-log_odds)), probability, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_a_part_is_exported_as_a_map_is(stores: dict[str, Path], method: str, tmp_path: Path) -> None:
    m = room_map(method)
    whole = take_part(ChunkedMap.open(stores[method]))
    voxels = ExportOptions(cells=False)  # cells follow from probabilities: without distances these are others
    for name in ("map.ply", "map.bt", "map.npz", "map.zarr"):
        export_map(m, tmp_path / name, voxels)
        export_map(whole, tmp_path / f"part_{name}", voxels)
    ours, theirs = (trimesh.load(tmp_path / name) for name in ("part_map.ply", "map.ply"))
    assert {tuple(p) for p in ours.vertices} == {tuple(p) for p in theirs.vertices}
    assert (tmp_path / "part_map.bt").stat().st_size == (tmp_path / "map.bt").stat().st_size
    points = places(m)
    again = ChunkedMap.open(tmp_path / "part_map.zarr")
    np.testing.assert_array_equal(again.state(points), m.state(points))


def test_the_command_takes_a_box_out(stores: dict[str, Path], tmp_path: Path) -> None:
    arch = runtime.active() or "cpu"
    box = ["--lower", "-1", "-1", "-1", "--upper", "1", "2", "1"]
    arguments = [str(stores["mrf"]), "--to", str(tmp_path / "part.ply"), "--arch", arch, *box]
    assert carry_out("export", *arguments) == 0
    found = np.asarray(trimesh.load(tmp_path / "part.ply").vertices)
    brick = 8 * room_map("mrf").voxel_size
    assert len(found)
    assert (found > np.array([-1, -1, -1]) - brick).all()
    assert (found < np.array([1, 2, 1]) + brick).all()
    room_map("mrf").save(tmp_path / "map.npz")
    with pytest.raises(ConfigError, match="is not one"):
        carry_out("export", tmp_path / "map.npz", *arguments[1:])


def test_a_folder_that_is_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "thesis.txt").write_text("important")
    with pytest.raises(MapFileError, match="not a map in chunks: it is not overwritten"):
        export_map(room_map("mrf"), tmp_path / "mine.zarr")
    assert [path.name for path in tmp_path.rglob("*.txt")] == ["thesis.txt"]
    with pytest.raises(MapFileError, match=r"not a (readable )?map"):
        ChunkedMap.open(tmp_path / "mine.zarr")
    with pytest.raises(MapFileError, match="no such folder"):
        ChunkedMap.open(tmp_path / "nowhere.zarr")


def test_a_store_is_whole_or_as_it_was(stores: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    write_chunks(path, room_map("mrf"))
    before = ChunkedMap.open(path).chunks
    header = StoreHeader.of(room_map("mrf").config, -2.0, -8.9, 0.1)

    def fail() -> None:
        with new_store(path) as place:
            ChunkStore.create(place, header, np.zeros((1, 3), np.int32))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    np.testing.assert_array_equal(ChunkedMap.open(path).chunks, before)
    assert [each.name for each in tmp_path.iterdir()] == ["map.zarr"]


def test_damage_and_newer_formats_are_told(stores: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    write_chunks(path, room_map("mrf"))
    victim = next(file for file in sorted((path / "log_odds" / "c").rglob("*")) if file.is_file())
    victim.write_bytes(victim.read_bytes()[:20])
    damaged = ChunkedMap.open(path)
    with pytest.raises(MapFileError, match="cannot be read"):
        damaged.voxels()
    meta = json.loads((path / "zarr.json").read_text())
    meta["attributes"]["taichi_mrf_map"] = 99
    (path / "zarr.json").write_text(json.dumps(meta))
    with pytest.raises(MapFileError, match="format 99"):
        ChunkedMap.open(path)
    with pytest.raises(MapFileError, match="format 99"):
        load_map(path)


def test_it_is_loaded_as_if_all_keyframes_had_been_frozen(stores: dict[str, Path], tmp_path: Path) -> None:
    m, loaded = room_map("mrf"), load_map(stores["mrf"])
    assert isinstance(loaded, MRFMap)
    assert (dict(loaded.keyframes), dict(loaded.frozen), loaded.up) == ({}, {0: "mrf.zarr"}, m.up)
    assert loaded.statistics().bricks == m.statistics().bricks
    points = places(m)
    expected = m.marginals.state(points)
    np.testing.assert_array_equal(loaded.state(points), expected)
    loaded.infer()
    np.testing.assert_array_equal(loaded.state(points), expected)
    loaded.save(tmp_path / "map.npz")
    np.testing.assert_array_equal(load_map(tmp_path / "map.npz").state(points), expected)


def test_one_without_such_evidence_is_not_loaded(stores: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"log_odds\.zarr: only maps of the method mrf"):
        load_map(stores["log_odds"])
    dated = MRFMap(0.1, time=TimeConfig(half_life_s=10.0))
    dated.add_keyframe(np.full((40, 40), 1.0, np.float32), np.eye(4), PinholeCamera(40, 40, 40, 40, 20, 20))
    dated.infer()
    export_map(dated, tmp_path / "dated.zarr")
    with pytest.raises(MapFileError, match=r"dated\.zarr: its world may change"):
        load_map(tmp_path / "dated.zarr")


def test_the_method_says_what_seen_free_space_holds(stores: dict[str, Path]) -> None:
    header = ChunkStore.open(stores["mrf"]).header
    assert header.seen_free_log_odds == header.prior_log_odds - Limits().message
    header = ChunkStore.open(stores["log_odds"]).header  # all bricks that rays cross exist
    assert header.seen_free_log_odds == header.prior_log_odds


def test_a_map_of_a_method_that_is_not_registered_says_so(stores: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    write_chunks(path, room_map("log_odds"))
    meta = json.loads((path / "zarr.json").read_text())
    changed = meta["attributes"]["config"].replace("method: log_odds", "method: toy")
    assert changed != meta["attributes"]["config"]
    meta["attributes"]["config"] = changed + "\ntoy:\n  boldness: 0.7\n"
    (path / "zarr.json").write_text(json.dumps(meta))
    with pytest.raises(MapFileError, match=r"method 'toy', which is not registered .*PLUGS"):
        ChunkedMap.open(path)


def test_without_zarr_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, stores: dict[str, Path]
) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(TaichiMRFError, match=r"pip install 'taichi-mrf\[store\]'"):
        ChunkedMap.open(stores["mrf"])
