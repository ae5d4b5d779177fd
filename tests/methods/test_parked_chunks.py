"""The folder of a map with a window: what it answers, and how it fares with saved maps and failing disks."""

import gc
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from sliding_camera import CAMERA
from window_walk import CHUNK_M, OUT, VOXEL, WINDOW_M, add, probes, unwindowed, walk, walk_both, windowed

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.errors import ConfigError, MapFileError, TaichiMRFError
from taichi_mrf.export.formats import export_map
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import render_chunked, take_part
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.visibility.map import VisibilityMap

pytest.importorskip("zarr", reason="a window needs the extra store")
pytestmark = pytest.mark.usefixtures("one_backend")


def test_the_folder_answers_queries_and_is_exported(tmp_path: Path) -> None:
    m, other = windowed(tmp_path / "far.zarr"), unwindowed()
    walk_both(m, other, OUT)
    m.save(tmp_path / "map.npz")
    whole = ChunkedMap.open(tmp_path / "map_window.zarr")
    part = take_part(whole)
    export_map(part, tmp_path / "part.ply")
    export_map(other, tmp_path / "whole.ply")
    ours, theirs = (trimesh.load(tmp_path / name) for name in ("part.ply", "whole.ply"))
    assert {tuple(p) for p in ours.vertices} == {tuple(p) for p in theirs.vertices}
    assert whole.up == other.up
    T_world_camera = np.eye(4)
    for place_m in (0.1, 3.3, 50.0):
        T_world_camera[0, 3] = place_m
        rendered = render_chunked(whole, CAMERA, T_world_camera)
        np.testing.assert_array_equal(rendered, other.render_depth(CAMERA, T_world_camera))
    # While the run went on, what had left the window could be read as well.
    assert m.window is not None
    parked = ChunkedMap.open(tmp_path / "far.zarr")
    points = probes(other)
    points = points[np.isin(np.floor(points / CHUNK_M), m.window.parked.chunks).all(axis=1)]
    gone = {tuple(chunk) for chunk in m.window.parked.chunks.tolist()}
    points = points[[tuple(c) in gone for c in np.floor(points / CHUNK_M).astype(int).tolist()]]
    assert len(points) > 1000
    np.testing.assert_array_equal(parked.state(points), other.state(points))


def test_keyframes_without_messages_are_swept_before_they_leave(tmp_path: Path) -> None:
    m = windowed(tmp_path / "far.zarr")
    for number, place_m in enumerate(OUT):
        add(m, place_m, number)
    assert len(m.frozen) > 5
    m.infer()
    m.save(tmp_path / "map.npz")
    whole = ChunkedMap.open(tmp_path / "map_window.zarr")
    wall = np.array([(x, 0.02, 1.52) for x in np.arange(0.0, 6.0, 0.1)])
    assert (whole.state(wall) == 2).all()


def test_a_saved_map_goes_on_where_it_was(tmp_path: Path) -> None:
    m = windowed(tmp_path / "map_window.zarr")
    walk(m, OUT)
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert loaded.window is not None
    assert m.window is not None
    assert len(loaded.window.parked) == len(m.window.parked) > 0
    for each in (m, loaded):
        each.infer()
        walk(each, [3.0, 0.0])
    points = probes(m)
    np.testing.assert_allclose(loaded.occupancy(points), m.occupancy(points), atol=1e-6)
    np.testing.assert_array_equal(loaded.state(points), m.state(points))


def test_a_map_that_was_saved_keeps_its_files_until_the_next_save(tmp_path: Path) -> None:
    m = windowed(tmp_path / "map_window.zarr")
    walk(m, OUT)
    m.save(tmp_path / "map.npz")
    named = {file.name for file in (tmp_path / "map_window.zarr" / "parked").iterdir()}
    walk(m, OUT[::-1])
    walk(m, OUT)
    assert named <= {file.name for file in (tmp_path / "map_window.zarr" / "parked").iterdir()}
    loaded = MRFMap.load(tmp_path / "map.npz")
    walk(loaded, [0.0])
    m.save(tmp_path / "map.npz")
    assert m.window is not None
    kept = {file.name for file in (tmp_path / "map_window.zarr" / "parked").iterdir()}
    assert kept == set(m.window.parked.names) != named


def test_a_missing_chunk_is_named(tmp_path: Path) -> None:
    m = windowed(tmp_path / "map_window.zarr")
    walk(m, OUT)
    m.save(tmp_path / "map.npz")
    file = min((tmp_path / "map_window.zarr" / "parked").iterdir())
    whole = file.read_bytes()
    file.unlink()
    with pytest.raises(MapFileError, match=file.name):
        MRFMap.load(tmp_path / "map.npz")
    file.write_bytes(whole[: len(whole) // 2])
    loaded = MRFMap.load(tmp_path / "map.npz")
    with pytest.raises(MapFileError, match=file.name):
        walk(loaded, OUT[::-1])


def test_chunks_that_came_back_before_an_error_are_not_read_again(tmp_path: Path) -> None:
    m, other = windowed(tmp_path / "far.zarr"), unwindowed()
    walk_both(m, other, [*OUT, 20.0])
    assert m.window is not None
    near = [name for name in m.window.parked.names if name.startswith(("0_", "1_"))]
    last = tmp_path / "far.zarr" / "parked" / near[-1]
    whole = last.read_bytes()
    last.write_bytes(b"")
    with pytest.warns(UserWarning, match="a chunk near the camera stays on disk"):
        m.window.follow(m, np.array([3.2, 0.0, 0.0]))
    last.write_bytes(whole)
    m.window.follow(m, np.array([3.2, 0.0, 0.0]))
    in_memory, occupancy = m.voxels(0.0)
    np.testing.assert_array_equal(occupancy, other.occupancy(in_memory))
    assert not any(name.startswith(("0_", "1_")) for name in m.window.parked.names)


def test_what_cannot_be_written_stays_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    m, other = windowed(tmp_path / "far.zarr"), unwindowed()
    walk_both(m, other, OUT[:3])
    monkeypatch.setattr("taichi_mrf.methods.mrf.parked_chunks.put_chunks", no_space)
    with pytest.warns(UserWarning, match="stays in memory: far.zarr: No space left"):
        walk_both(m, other, OUT[3:])
    points = probes(other)
    np.testing.assert_array_equal(m.occupancy(points), other.occupancy(points))
    monkeypatch.undo()
    walk_both(m, other, [12.0])
    assert m.window is not None
    assert len(m.window.parked) > 1


def no_space(*arguments: object) -> None:
    raise MapFileError("far.zarr: No space left on device")


def test_without_a_folder_a_temporary_one_is_used_and_named() -> None:
    m = windowed()
    with pytest.warns(UserWarning, match="volume.window_m: the map outside the window is kept in"):
        walk(m, OUT)
    assert m.window is not None
    folder = m.window.folder
    assert folder is not None
    assert ChunkedMap.open(folder).chunks.shape[0] > 0
    del m
    gc.collect()
    assert not folder.exists()


def test_a_map_of_an_earlier_run_is_replaced(tmp_path: Path) -> None:
    walk(windowed(tmp_path / "far.zarr"), OUT)
    before = len(ChunkedMap.open(tmp_path / "far.zarr").chunks)
    m = windowed(tmp_path / "far.zarr")
    walk(m, [30.0])
    assert len(ChunkedMap.open(tmp_path / "far.zarr").chunks) == before
    walk(m, [38.0, 46.0])
    assert m.window is not None
    assert len(ChunkedMap.open(tmp_path / "far.zarr").chunks) == len(m.window.parked) != before
    (tmp_path / "other.zarr").mkdir()
    m.window.park_in(tmp_path / "copy.zarr")
    assert len(ChunkedMap.open(tmp_path / "copy.zarr").chunks) == len(m.window.parked)
    with pytest.raises(MapFileError, match="is not a map in chunks"):
        m.window.park_in(tmp_path / "other.zarr")


@pytest.mark.parametrize("method", [LogOddsMap, VisibilityMap])
def test_methods_that_cannot_freeze_refuse_a_window(method: type) -> None:
    with pytest.raises(ConfigError, match=r"volume.window_m needs the method mrf, not"):
        method(VOXEL, volume=VolumeConfig(window_m=WINDOW_M))


def test_without_zarr_the_error_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(TaichiMRFError, match=r"volume.window_m needs zarr, which is not installed: pip"):
        windowed()


@pytest.mark.parametrize("size", [-1.0, float("nan"), float("inf")])
def test_an_impossible_window_is_refused(size: float) -> None:
    with pytest.raises(ConfigError, match=r"volume.window_m must be 0 or a number of metres"):
        VolumeConfig(window_m=size)
