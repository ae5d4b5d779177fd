"""A window that follows the camera: what leaves it comes back as it was, and the folder holds the rest."""

import gc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from sliding_camera import CAMERA
from window_walk import CHUNK_M, VOXEL, WINDOW_M, add, probes, walk, walk_both, windowed

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.export.formats import export_map
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import ChunkedViews, take_part
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.visibility.map import VisibilityMap

pytest.importorskip("zarr", reason="a window needs the extra store")
pytestmark = pytest.mark.usefixtures("backend")

OUT = [0.5 * step for step in range(13)]
"""Places on the way out, metres: almost two chunks."""


def content(m: MRFMap) -> dict[str, np.ndarray]:
    """All that is kept of frozen keyframes, in the order of the bricks."""
    registry, pool = m._registry, m._pool
    slots = pool.in_order
    crossed = registry.frozen_crossed
    return {
        "bricks": pool.bricks[slots],
        "belief": pool.read("belief", slots),
        "evidence": pool.read("evidence", slots),
        "owners": pool.owners[slots],
        "crossed": crossed,
        "crossings": registry.topology.crossings(crossed),
        "slots exist": registry.topology.slots(pool.bricks[slots]) == slots,
    }


def test_what_leaves_comes_back_bit_for_bit(tmp_path: Path) -> None:
    m = windowed(tmp_path / "far.zarr")
    walk(m, OUT[:3])
    for id in list(m.keyframes):
        m.freeze_keyframe(id)
    assert m.window is not None
    before, points = content(m), probes(m)
    occupancy, state = m.occupancy(points), m.state(points)
    m.window.follow(m, np.array([50.0, 0.0, 0.0]))
    assert m.statistics().bricks == len(m._registry.frozen_crossed) == 0
    assert (m.state(points) == 0).all()
    assert len(m.window.parked) > 1
    m.window.follow(m, np.zeros(3))
    assert len(m.window.parked) == 0
    for name, values in content(m).items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)
    np.testing.assert_array_equal(m.occupancy(points), occupancy)
    np.testing.assert_array_equal(m.state(points), state)


@settings(max_examples=6)
@given(places=st.lists(st.integers(-8, 8), min_size=2, max_size=9))
def test_any_walk_ends_in_the_map_without_a_window(
    places: list[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("walk")
    m, other = windowed(folder / "far.zarr"), MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128))
    walk_both(m, other, [1.1 * place for place in places])
    m.save(folder / "map.npz")
    whole, points = ChunkedMap.open(folder / "map_window.zarr"), probes(other)
    np.testing.assert_array_equal(whole.state(points), other.state(points))
    np.testing.assert_allclose(whole.occupancy(points), other.occupancy(points), atol=1e-6)
    assert m.window is not None
    m.window.follow(m, np.array([1.1 * places[0], 0.0, 0.0]))
    in_memory, _ = m.voxels(0.0)
    np.testing.assert_array_equal(m.occupancy(in_memory), other.occupancy(in_memory))


def test_the_surface_that_keyframes_are_aligned_with_comes_back(tmp_path: Path) -> None:
    m, other = windowed(tmp_path / "far.zarr"), MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128))
    for each in (m, other):
        each.aligner.surface.update(each.keyframes)
        each.infer(keyframes=[add(each, 0.0)])
        each.aligner.surface.update(each.keyframes)  # from here on the surface of frozen keyframes is kept
    walk_both(m, other, OUT[1:])
    surface = m.aligner.surface
    everywhere = (np.full(3, -9.0), np.full(3, 9.0))
    assert len(surface.around(*everywhere).keys) < 0.7 * len(other.aligner.surface.around(*everywhere).keys)
    walk_both(m, other, [3.0, 0.0])
    box = (np.array([-1.0, -1.0, 1.0]), np.array([1.0, 1.0, 2.0]))
    ours, theirs = surface.around(*box), other.aligner.surface.around(*box)
    np.testing.assert_array_equal(ours.keys, theirs.keys)
    np.testing.assert_allclose(ours.sums, theirs.sums)


def test_dated_evidence_comes_back_with_its_date(tmp_path: Path) -> None:
    options = {"time": TimeConfig(half_life_s=2.0)}
    m = windowed(tmp_path / "far.zarr", **options)
    other = MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128), **options)
    walk_both(m, other, OUT)
    assert m.window is not None
    assert len(m.window.parked) > 1
    walk_both(m, other, [4.0, 2.0, 0.0])
    in_memory, occupancy = m.voxels(0.0)
    np.testing.assert_allclose(occupancy, other.occupancy(in_memory), atol=1e-4)
    np.testing.assert_allclose(
        m.at(10.0).occupancy(in_memory), other.at(10.0).occupancy(in_memory), atol=1e-4
    )
    # Time has passed: what was seen on the way out alone is less sure than it was.
    static = MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128))
    walk(static, [*OUT, 4.0, 2.0, 0.0])
    assert np.abs(static.occupancy(in_memory) - occupancy).max() > 0.05


def test_memory_is_bounded_on_a_long_way(tmp_path: Path) -> None:
    m = windowed(tmp_path / "far.zarr")
    bricks = walk(m, [0.4 * step for step in range(60)])
    assert max(bricks[30:]) <= max(bricks[:30])
    assert len(m.keyframes) < 8
    assert m.window is not None
    assert len(m.window.parked) > 5
    # What is in memory lies near the camera, or in a chunk that a keyframe in the window sees.
    centres, _ = m.voxels(0.0)
    assert np.abs(centres[:, 0] - 0.4 * 59).max() < 1.35 * WINDOW_M + 2 * CHUNK_M


def test_the_folder_answers_queries_and_is_exported(tmp_path: Path) -> None:
    m, other = windowed(tmp_path / "far.zarr"), MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128))
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
        rendered = ChunkedViews(whole).render_depth(CAMERA, T_world_camera)
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
    m, other = windowed(tmp_path / "far.zarr"), MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128))
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
    m, other = windowed(tmp_path / "far.zarr"), MRFMap(VOXEL, volume=VolumeConfig(dense_bricks=128))
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
    with pytest.warns(UserWarning, match="volume.window_m: what lies outside the window is kept in"):
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


@pytest.mark.parametrize("size", [-1.0, float("nan"), float("inf")])
def test_an_impossible_window_is_refused(size: float) -> None:
    with pytest.raises(ConfigError, match=r"volume.window_m must be 0 or a number of metres"):
        VolumeConfig(window_m=size)
