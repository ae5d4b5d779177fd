"""Sums over points, cell by cell: they add up, whatever the cells and the order."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.surfels import Surfels, merged, surfels_of
from taichi_mrf.geometry.poses import look_at

CELL = 0.07


def some_points(seed: int, count: int) -> OrientedPoints:
    random = np.random.default_rng(seed)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return OrientedPoints(
        random.uniform(-2, 2, (count, 3)).astype(np.float32),
        normals.astype(np.float32),
        random.uniform(0, 0.03, count).astype(np.float32),
        random.integers(0, 40, (count, 2)).astype(np.int32),
    )


def some_surfels(seed: int, count: int = 300) -> Surfels:
    return surfels_of(some_points(seed, count), look_at((seed, 2.0, -1.0), (0, 0, 0)), CELL)


@given(st.integers(0, 20), st.integers(1, 400))
def test_every_point_is_in_its_cell(seed: int, count: int) -> None:
    points, T = some_points(seed, count), look_at((seed, 2.0, -1.0), (0, 0, 0))
    surfels = surfels_of(points, T, CELL)
    world = points.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    cells, number = np.unique(np.floor(world / CELL).astype(int), axis=0, return_inverse=True)
    np.testing.assert_array_equal(surfels.cells, cells)
    weights = 1 / (1 + (points.sigmas.astype(np.float64) / (0.2 * CELL)) ** 2)
    np.testing.assert_allclose(surfels.sums[:, 0], np.bincount(number.reshape(-1), weights))
    means = surfels.sums[:, 1:4] / surfels.sums[:, :1]
    assert (np.abs(means - (cells + 0.5) * CELL) <= 0.5 * CELL + 1e-9).all()


@given(st.lists(st.integers(0, 9), max_size=4), st.integers(1, 5))
def test_nothing_is_lost_or_counted_twice(seeds: list[int], factor: int) -> None:
    parts = [some_surfels(seed) for seed in seeds]
    together = merged(parts, CELL)
    total = sum((part.sums.sum(axis=0) for part in parts), np.zeros(7))
    np.testing.assert_allclose(together.sums.sum(axis=0), total, atol=1e-9)
    wide = together.coarser(factor)
    np.testing.assert_allclose(wide.sums.sum(axis=0), total, atol=1e-9)
    assert wide.cell_size == CELL * factor
    assert {tuple(c) for c in (together.cells // factor).tolist()} == {tuple(c) for c in wide.cells.tolist()}
    assert (np.diff(together.keys) > 0).all()


@given(st.integers(0, 9), st.floats(-2, 2), st.floats(0, 2))
def test_a_box_cuts_out_its_cells(seed: int, lower: float, size: float) -> None:
    surfels = some_surfels(seed)
    low, high = np.full(3, lower), np.full(3, lower + size)
    inside = surfels.within(low, high)
    centres = (surfels.cells + 0.5) * CELL
    clearly = ((centres > low + CELL) & (centres < high - CELL)).all(axis=1)
    outside = ((centres < low - CELL) | (centres > high + CELL)).any(axis=1)
    assert np.isin(surfels.keys[clearly], inside.keys).all()
    assert not np.isin(surfels.keys[outside], inside.keys).any()


def test_cells_that_hold_an_edge_are_no_planes() -> None:
    def at(point: tuple[float, float, float], *normals: tuple[float, float, float]) -> OrientedPoints:
        n = len(normals)
        return OrientedPoints(
            np.tile(np.float32(point), (n, 1)),
            np.array(normals, np.float32),
            np.zeros(n, np.float32),
            np.zeros((n, 2), np.int32),
        )

    flat = surfels_of(at((0.03, 0.03, 0.03), (0, 0, 1), (0.1, 0, 0.995)), np.eye(4), CELL)
    edge = surfels_of(at((1.03, 0.03, 0.03), (0, 0, 1), (1, 0, 0)), np.eye(4), CELL)
    sheet = surfels_of(at((2.03, 0.03, 0.03), (0, 0, 1), (0, 0, -1)), np.eye(4), CELL)
    planes = merged([sheet, edge, flat], CELL).planes()
    np.testing.assert_array_equal(planes.cells, [[0, 0, 0]])
    np.testing.assert_allclose(planes.points_m, [[0.03, 0.03, 0.03]], atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(planes.normals, axis=1), 1)
