"""Windows: boxes of bricks, exact however far away, and an index that is empty again after use."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.errors import CapacityError
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, VOXELS
from taichi_mrf.voxels.window import Window, WindowIndex

pytestmark = pytest.mark.backends

sizes = st.sampled_from([0.01, 0.02, 0.05, 0.3])
metres = st.floats(-200, 200)
points = st.tuples(metres, metres, metres).map(np.array)
extents = st.tuples(st.floats(0, 8), st.floats(0, 8), st.floats(0, 8)).map(np.array)


@given(points, extents, sizes)
def test_covering_is_the_smallest_box_of_chunks(
    lower: np.ndarray, extent: np.ndarray, voxel_size: float
) -> None:
    upper = lower + extent * (voxel_size / 0.05)
    window = Window.covering(lower, upper, voxel_size)
    lowest, shape = np.array(window.lowest), np.array(window.shape)
    assert (lowest % CHUNK == 0).all()
    assert (shape % CHUNK == 0).all()
    # The corners lie in the first and in the last chunk, give or take a rounding error on a face.
    rounding = 1e-9
    first, last = lowest * BRICK * voxel_size, (lowest + shape) * BRICK * voxel_size
    chunk_m = CHUNK_VOXELS * voxel_size
    assert (first <= lower + rounding).all()
    assert (lower < first + chunk_m + rounding).all()
    assert (upper < last + rounding).all()
    assert (last <= upper + chunk_m + rounding).all()
    assert window.cells == shape.prod()


@given(points, st.integers(0, 2**31), sizes)
def test_cells_and_bricks_go_round(lower: np.ndarray, seed: int, voxel_size: float) -> None:
    window = Window.covering(lower, lower + 70 * voxel_size, voxel_size)
    cells = np.random.default_rng(seed).integers(0, window.cells, 50).astype(np.int32)
    bricks = window.bricks_of(cells)
    local = bricks - np.array(window.lowest)
    assert ((local >= 0) & (local < window.shape)).all()
    np.testing.assert_array_equal(window.cells_of(bricks), cells)
    assert bricks.dtype == cells.dtype == np.int32


def test_all_cells_are_different_bricks_in_row_major_order() -> None:
    window = Window((-16, 8, -8), (16, 8, 24), 0.05)
    bricks = window.bricks_of(np.arange(window.cells, dtype=np.int32))
    x, y, z = (np.arange(n) + low for n, low in zip(window.shape, window.lowest, strict=True))
    expected = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_array_equal(bricks, expected)


def test_bricks_outside_have_no_cell() -> None:
    window = Window((-16, 8, -8), (16, 8, 24), 0.05)
    inside = np.array([[-16, 8, -8], [-1, 15, 15]])
    outside = np.array([[-17, 8, -8], [0, 8, 0], [-5, 7, 0], [-5, 16, 0], [-5, 9, -9], [-5, 9, 16]])
    assert window.cells_of(inside).tolist() == [0, window.cells - 1]
    assert (window.cells_of(outside) == -1).all()
    assert window.cells_of(np.zeros((0, 3), np.int32)).tolist() == []


@given(
    st.tuples(*[st.integers(-(10**6), 10**6)] * 3).map(np.array),
    st.tuples(*[st.floats(0, 64)] * 3).map(np.array),
    sizes,
)
def test_voxel_coordinates_are_exact_far_from_the_origin(
    chunk: np.ndarray, offset: np.ndarray, voxel_size: float
) -> None:
    """Up to 640 km at 1 cm: the error stays below what float32 can tell in the window."""
    lowest = tuple(int(c) * CHUNK for c in chunk)
    window = Window(lowest, (CHUNK,) * 3, voxel_size)  # type: ignore[arg-type]
    point = (chunk.astype(np.float64) * CHUNK_VOXELS + offset) * voxel_size
    np.testing.assert_allclose(window.to_voxels(point), offset, rtol=0, atol=1e-7)


@given(points, points, sizes)
def test_camera_rays_in_the_window_are_those_of_the_world(
    eye: np.ndarray, direction: np.ndarray, voxel_size: float
) -> None:
    T = look_at(eye, eye + np.array([1, 2, -0.5]))
    window = Window.covering(eye - 10 * voxel_size, eye + 10 * voxel_size, voxel_size)
    view = window.viewpoint(T)
    np.testing.assert_allclose(view.centre.to_numpy(), window.to_voxels(eye), rtol=1e-6)
    world = T[:3, :3] @ direction
    in_voxels = view.to_voxels.to_numpy().astype(np.float64) @ direction * voxel_size
    np.testing.assert_allclose(in_voxels, world, atol=1e-6 * (1 + np.abs(direction).sum()))


def test_the_clip_box_is_the_windows_part_of_the_volume() -> None:
    window = Window((-8, 0, 0), (8, 8, 16), 0.05)  # from (-3.2, 0, 0) to (0, 3.2, 6.4) m
    lower, upper = window.clip_box(None, None)
    assert (lower.to_list(), upper.to_list()) == ([0, 0, 0], [64, 64, 128])
    lower, upper = window.clip_box((-1.0, -5.0, 1.0), (9.0, 2.5, 2.0))
    assert (lower.to_list(), upper.to_list()) == ([44, 0, 20], [64, 50, 40])


def test_a_view_that_cannot_fit_says_how_much_it_would_take() -> None:
    with pytest.raises(CapacityError, match=r"voxel size of 1e-06 m would need .* GB"):
        Window.covering((0, 0, 0), (10, 10, 10), 1e-6)


def test_filling_and_clearing_leaves_the_index_empty(backend: str) -> None:
    index = WindowIndex()
    random = np.random.default_rng(0)
    windows = [Window((0, 0, 0), (16, 8, 24), 0.05), Window((-8, -8, 0), (8, 8, 8), 0.05),
               Window((8, 8, 8), (24, 32, 16), 0.02)]  # fmt: skip
    for window in windows + windows[::-1]:
        cells = np.sort(random.choice(window.cells, 40, replace=False)).astype(np.int32)
        slots = random.permutation(1000)[:40].astype(np.int32)
        index.fill(window, cells, slots)
        bricks, chunks = index.bricks.to_numpy(), index.chunks.to_numpy()
        expected = np.full(len(bricks), -1)
        expected[cells] = slots
        np.testing.assert_array_equal(bricks, expected)
        chunk_shape = np.array(window.shape) // CHUNK
        chunk_of = (window.bricks_of(cells) - np.array(window.lowest)) // CHUNK
        busy = np.zeros(len(chunks), bool)
        busy[np.ravel_multi_index(tuple(chunk_of.T), tuple(chunk_shape))] = True
        np.testing.assert_array_equal(chunks > 0, busy)
        index.clear(window, cells)
        assert (index.bricks.to_numpy() == -1).all()
        assert (index.chunks.to_numpy() == 0).all()
    assert len(index.bricks.to_numpy()) == max(w.cells for w in windows)
    assert len(index.chunks.to_numpy()) * VOXELS == len(index.bricks.to_numpy())


def test_an_index_can_be_filled_with_nothing(backend: str) -> None:
    index, window = WindowIndex(), Window((0, 0, 0), (8, 8, 8), 0.05)
    none = np.zeros(0, np.int32)
    index.fill(window, none, none)
    index.clear(window, none)
    assert (index.bricks.to_numpy() == -1).all()
