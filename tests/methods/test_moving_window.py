"""A window that follows the camera: what leaves it comes back as it was, and memory is bounded."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sliding_camera import WALL_M
from window_walk import CHUNK_M, OUT, WINDOW_M, add, probes, unwindowed, walk, walk_both, windowed

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import take_part
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.voxels.layout import CHUNK_VOXELS

pytest.importorskip("zarr", reason="a window needs the extra store")
pytestmark = pytest.mark.usefixtures("backend")


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
    m = windowed(tmp_path / "far.zarr", keep_surface=True)
    walk(m, OUT[:3], colored=True)
    for id in list(m.keyframes):
        m.freeze_keyframe(id)
    field = m.surface_field()
    assert field.weight.any()
    assert m.window is not None
    before, points = content(m), probes(m)
    occupancy, state, colors = m.occupancy(points), m.state(points), m.colors(points)
    assert colors.any()
    m.window.follow(m, np.array([50.0, 0.0, 0.0]))
    assert m.statistics().bricks == len(m._registry.frozen_crossed) == 0
    assert (m.state(points) == 0).all()
    assert not m.colors(points).any()
    assert not len(m.surface_field().bricks)
    gone = ChunkedMap.open(tmp_path / "far.zarr")
    np.testing.assert_array_equal(gone.colors(points), colors)
    stored = take_part(gone).surface_field()
    for place in field.chunks.astype(np.int64) * CHUNK_VOXELS:
        np.testing.assert_array_equal(stored.box(place, CHUNK_VOXELS), field.box(place, CHUNK_VOXELS))
    assert len(m.window.parked) > 1
    m.window.follow(m, np.zeros(3))
    assert len(m.window.parked) == 0
    for name, values in content(m).items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)
    np.testing.assert_array_equal(m.occupancy(points), occupancy)
    np.testing.assert_array_equal(m.state(points), state)
    np.testing.assert_array_equal(m.colors(points), colors)
    for ours, theirs in (
        (m.surface_field().bricks, field.bricks),
        (m.surface_field().distance, field.distance),
    ):
        np.testing.assert_array_equal(ours, theirs)


@settings(max_examples=6)
@given(places=st.lists(st.integers(-8, 8), min_size=2, max_size=9))
def test_any_walk_ends_in_the_map_without_a_window(
    places: list[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("walk")
    m, other = windowed(folder / "far.zarr"), unwindowed()
    walk_both(m, other, [1.1 * place for place in places])
    m.save(folder / "map.npz")
    whole, points = ChunkedMap.open(folder / "map_window.zarr"), probes(other)
    np.testing.assert_array_equal(whole.state(points), other.state(points))
    np.testing.assert_allclose(whole.occupancy(points), other.occupancy(points), atol=1e-6)
    assert m.window is not None
    m.window.follow(m, np.array([1.1 * places[0], 0.0, 0.0]))
    in_memory, _ = m.voxels(0.0)
    np.testing.assert_array_equal(m.occupancy(in_memory), other.occupancy(in_memory))


def test_the_folder_holds_surface_and_colours_of_the_whole_map(tmp_path: Path) -> None:
    m, other = windowed(tmp_path / "far.zarr", keep_surface=True), unwindowed(keep_surface=True)
    walk_both(m, other, OUT, colored=True)
    assert m.window is not None
    assert len(m.window.parked) > 1
    for each in (m, other):
        each.infer()
    m.save(tmp_path / "map.npz")
    part, points = take_part(ChunkedMap.open(tmp_path / "map_window.zarr")), probes(other)
    np.testing.assert_array_equal(part.colors(points), other.colors(points))
    reading = ChunkedMap.open(tmp_path / "map_window.zarr").decided
    np.testing.assert_array_equal(reading.state(points), other.decided.state(points))
    field, stored = other.surface_field(), part.surface_field()
    for place in field.chunks.astype(np.int64) * CHUNK_VOXELS:
        np.testing.assert_allclose(
            stored.box(place, CHUNK_VOXELS), field.box(place, CHUNK_VOXELS), rtol=1e-5, atol=1e-5
        )
    again = MRFMap.load(tmp_path / "map.npz")
    np.testing.assert_array_equal(again.surface_field().weight, m.surface_field().weight)


def test_the_surface_that_keyframes_are_aligned_with_comes_back(tmp_path: Path) -> None:
    m, other = windowed(tmp_path / "far.zarr"), unwindowed()
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
    other = unwindowed(**options)
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
    static = unwindowed()
    walk(static, [*OUT, 4.0, 2.0, 0.0])
    assert np.abs(static.occupancy(in_memory) - occupancy).max() > 0.05


def test_what_waits_for_older_keyframes_leaves_with_its_chunk(tmp_path: Path) -> None:
    """The way back of a recording that comes last to first: the window freezes the newest."""
    options = {"time": TimeConfig(half_life_s=2.0)}
    m, other = windowed(tmp_path / "far.zarr", **options), unwindowed(**options)
    for number, place_m in enumerate(OUT):
        ids = [add(each, place_m, number, stamp_s=-float(number)) for each in (m, other)]
        for id in m.frozen.keys() & other.keyframes.keys():
            other.freeze_keyframe(id)
        m.renew(ids[:1])
        other.renew(ids[1:])
    assert m.window is not None
    assert m._parts.dated is not None
    assert m._parts.dated.waiting_bytes > 0
    assert len(m.window.parked) > 1
    for each in (m, other):
        for id in list(each.keyframes):
            each.freeze_keyframe(id)
    m.window.follow(m, np.zeros(3))
    beside = np.stack([np.linspace(0.0, 0.5, 50), np.full(50, 0.02), np.full(50, WALL_M)], axis=1)
    assert (m.occupancy(beside) > 0.3).mean() > 0.5
    in_memory, occupancy = m.voxels(0.0)
    np.testing.assert_allclose(occupancy, other.occupancy(in_memory), atol=1e-4)


def test_memory_is_bounded_on_a_long_path(tmp_path: Path) -> None:
    m = windowed(tmp_path / "far.zarr")
    bricks = walk(m, [0.4 * step for step in range(60)])
    assert max(bricks[30:]) <= max(bricks[:30])
    assert len(m.keyframes) < 8
    assert m.window is not None
    assert len(m.window.parked) > 5
    # What is in memory lies near the camera, or in a chunk that a keyframe in the window sees.
    centres, _ = m.voxels(0.0)
    assert np.abs(centres[:, 0] - 0.4 * 59).max() < 1.35 * WINDOW_M + 2 * CHUNK_M
