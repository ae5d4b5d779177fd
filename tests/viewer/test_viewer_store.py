"""The viewer's copy of a map: what is put in comes out, whatever the history; cuts and slabs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.geometry.up import Z_UP
from taichi_mrf.viewer.messages import LOG_ODDS_STEP, pack_log_odds
from taichi_mrf.viewer.scene.map_scene import brick_edges
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.voxel_layer import FREE, OCCUPIED, UNKNOWN, cut_of, cut_picture
from taichi_mrf.viewer.scene.voxel_store import Cut, VoxelStore
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS, VOXELS, offsets_in_brick


def world_of(store: VoxelStore, log_odds: float, cut: Cut | None = None) -> dict[tuple[int, ...], int]:
    """Voxel coordinates -> packed log-odds of everything that is shown."""
    found = {}
    for key in store.chunks:
        shown = store.shown(key, log_odds, cut)
        voxels = shown.cells.astype(np.int64) + np.array(key) * CHUNK_VOXELS
        found |= {tuple(v): int(q) for v, q in zip(voxels.tolist(), shown.log_odds, strict=True)}
    return found


def expected(bricks: dict[tuple[int, ...], np.ndarray], log_odds: float) -> dict[tuple[int, ...], int]:
    """The answer by brute force."""
    found = {}
    for brick, values in bricks.items():
        for offset, value in zip(offsets_in_brick(), values, strict=True):
            if value * LOG_ODDS_STEP >= log_odds:
                found[tuple((np.array(brick) * BRICK + offset).tolist())] = int(value)
    return found


coordinates = st.tuples(*[st.integers(-20, 20)] * 3)


@given(
    history=st.lists(st.tuples(st.booleans(), st.sets(coordinates, min_size=1, max_size=4)), max_size=8),
    seed=st.integers(0, 1000),
    log_odds=st.floats(-3, 3, allow_subnormal=False),  # kernels make a process flush those to 0
)
def test_what_is_put_in_and_not_removed_is_shown(
    history: list[tuple[bool, set[tuple[int, ...]]]], seed: int, log_odds: float
) -> None:
    rng = np.random.default_rng(seed)
    store, known = VoxelStore(), {}
    for is_put, bricks in history:
        coords = np.array(sorted(bricks), np.int32)
        if is_put:
            values = rng.integers(-3000, 3000, (len(coords), VOXELS)).astype(np.int16)
            changed = store.put(coords, log_odds=values)
            assert changed == {tuple(c) for c in (coords // 8).tolist()}
            known |= {tuple(c): v for c, v in zip(coords.tolist(), values, strict=True)}
        else:
            store.remove(coords)
            for brick in bricks:
                known.pop(brick, None)
    assert world_of(store, log_odds) == expected(known, log_odds)
    assert {tuple(b) for b in store.bricks().tolist()} == set(known)


def test_counts_travel_with_their_voxels() -> None:
    store = VoxelStore()
    seen = np.arange(VOXELS, dtype=np.int64).reshape(1, -1) % 251
    store.put(
        np.array([[-1, 2, 3]], np.int32),
        log_odds=np.full((1, VOXELS), 9, np.int16),
        seen=seen.astype(np.uint8),
    )
    shown = store.shown((-1, 0, 0), 0.0, None)
    number = shown.cells % BRICK @ np.array([BRICK * BRICK, BRICK, 1])
    np.testing.assert_array_equal(shown.seen, number % 251)


@given(
    st.lists(st.floats(-70, 70, width=32, allow_subnormal=False), min_size=1).map(
        lambda values: np.array(values, np.float32)
    )
)
def test_packing_keeps_the_sign_and_two_thousandths(log_odds: np.ndarray) -> None:
    packed = pack_log_odds(log_odds)
    np.testing.assert_array_equal(packed >= 0, log_odds >= 0)
    inside = np.abs(log_odds) < 63.9
    assert np.all(np.abs(packed * LOG_ODDS_STEP - log_odds)[inside] <= LOG_ODDS_STEP)


def put_block(store: VoxelStore, *brick: int) -> None:
    """Put a brick that is occupied where x < 3, free where x > 4, unknown between."""
    x = offsets_in_brick()[:, 0]
    log_odds = np.select([x < 3, x > 4], [2.0, -6.0], -2.0).astype(np.float32)
    store.put(np.array([brick], np.int32), log_odds=pack_log_odds(log_odds)[None])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_cut_hides_what_lies_beyond_it(axis: int) -> None:
    store = VoxelStore()
    for brick in ((-9, 0, 0), (0, -9, 0), (0, 0, -9), (0, 0, 0)):
        put_block(store, *brick)
    cut = Cut(axis, -5)
    everything, kept = world_of(store, -50.0), world_of(store, -50.0, cut)
    assert kept == {voxel: q for voxel, q in everything.items() if voxel[axis] <= cut.voxel}
    flipped = world_of(store, -50.0, Cut(axis, -5, flipped=True))
    assert flipped == {voxel: q for voxel, q in everything.items() if voxel[axis] >= cut.voxel}
    assert 0 < len(kept) < len(everything)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_cut_shows_free_occupied_and_unknown_where_they_are(axis: int) -> None:
    store = VoxelStore()
    bricks = [(-9, 0, 2), (1, -3, 0), (0, 0, 0)]
    for brick in bricks:
        put_block(store, *brick)
    crossed = np.array([[0, -1, 1], [0, 0, 0], [50, 50, 50]], np.int32)
    cut = Cut(axis, 2)
    picture = cut_picture(store, cut, -2.0, 0.1, [crossed])
    low = store.bounds()[0] * BRICK
    columns, rows = [(1, 2), (2, 0), (0, 1)][axis]
    for row in range(picture.shape[0]):
        for column in range(picture.shape[1]):
            voxel = np.zeros(3, int)
            voxel[axis], voxel[rows], voxel[columns] = cut.voxel, row + low[rows], column + low[columns]
            brick = tuple((voxel // BRICK).tolist())
            if brick in bricks:
                x = voxel[0] % BRICK
                wanted = OCCUPIED if x < 3 else FREE if x > 4 else UNKNOWN
            else:
                wanted = FREE if brick in {tuple(c) for c in crossed.tolist()} else UNKNOWN
            assert tuple(picture[row, column]) == wanted, voxel


def test_the_cut_goes_from_one_end_of_the_map_to_the_other() -> None:
    store = VoxelStore()
    assert cut_of(ViewOptions(cut_axis="x"), store, Z_UP, 0.1) is None
    put_block(store, -2, 0, 0)
    put_block(store, 3, 0, 0)
    assert cut_of(ViewOptions(), store, Z_UP, 0.1) is None
    for at_m, voxel in ((-5.0, -16), (0.3, 3), (0.39, 3), (5.0, 31)):
        options = ViewOptions(cut_axis="x", cut_at_m=at_m)
        for up in (Z_UP, (0, 1), (1, -1)):
            assert cut_of(options, store, up, 0.1) == Cut(0, voxel)
        # Where x points down, the cut is at a height, and opens the map from above as elsewhere.
        options = ViewOptions(cut_axis="x", cut_at_m=-at_m)
        assert cut_of(options, store, (0, -1), 0.1) == Cut(0, voxel, flipped=True)
        assert cut_of(replace(options, flip_cut=True), store, (0, -1), 0.1) == Cut(0, voxel)


@given(st.sets(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1, max_size=12))
def test_each_edge_of_a_brick_is_drawn_once(bricks: set[tuple[int, ...]]) -> None:
    wanted = set()
    for brick in bricks:
        corners = [tuple(np.add(brick, c)) for c in np.ndindex(2, 2, 2)]
        wanted |= {(a, b) for a in corners for b in corners if a < b and np.abs(np.subtract(a, b)).sum() == 1}
    edges = brick_edges(np.array(sorted(bricks), np.int64))
    drawn = [tuple(tuple(point) for point in edge) for edge in edges.tolist()]
    assert len(drawn) == len(set(drawn))
    assert set(drawn) == wanted


@given(cut=st.builds(Cut, st.integers(0, 2), st.integers(-9, 9), st.booleans()))
def test_a_cut_and_its_other_side_keep_each_voxel_once(cut: Cut) -> None:
    middles = np.arange(-12, 12) + 0.5
    np.testing.assert_array_equal(cut.keeps(middles), ~cut.other_side.keeps(middles))
    assert cut.other_side.other_side == cut
