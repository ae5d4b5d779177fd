"""Cells of voxels, against lines of voxels in NumPy."""

import itertools

import numpy as np
import pytest
from hand_made import PRIOR
from queried_maps import HandMap, map_of

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.cells import all_cells, standing_cells


def expected(log_odds: np.ndarray) -> float:
    """Of the voxels of one cell, (side, side, side)."""
    m, evidence = 1 / (1 + np.exp(-log_odds)), log_odds.astype(np.float32) > np.float32(PRIOR)
    surface, rest = np.where(evidence, m, 0), np.where(evidence, 1, 1 - m)
    return float(min(1 - (rest.prod(axis) * np.maximum(0, 1 - surface.sum(axis))).min() for axis in range(3)))


@pytest.mark.parametrize("side", [2, 4, 8])
def test_a_cell_has_the_probability_of_its_likeliest_line(hand: HandMap, side: int) -> None:
    cells = all_cells(hand, side)
    assert len(cells.lowest) == len(hand.hand.bricks) * (8 // side) ** 3
    inside = np.array(list(itertools.product(range(side), repeat=3)))
    for row in np.random.default_rng(1).integers(0, len(cells.lowest), 20):
        log_odds = hand.true_log_odds(cells.lowest[row] + inside).reshape((side,) * 3)
        assert cells.probability[row] == pytest.approx(expected(log_odds), abs=1e-5)
    assert np.allclose(cells.centres(0.05)[3], (cells.lowest[3] + side / 2) * 0.05)


def test_cells_stand_in_for_voxels_only_where_none_is_likely(backend: str) -> None:
    """Along a wall: likely voxels, two layers that are likely together, four such layers, and too little."""
    log_odds = np.full((8, 32, 8), -9.0)
    log_odds[3, :8] = 2.0
    log_odds[2:4, 8:16] = -0.5  # 2 * .38 = .76
    log_odds[0:4, 16:24] = -1.5  # 4 * .18 = .73
    log_odds[3, 24:] = -0.5
    wall = map_of(backend, (0, 0, 0), log_odds)
    of_two, of_four, of_eight = standing_cells(wall)
    assert {tuple(cell) for cell in of_two.lowest.tolist()} == {
        (2, y, z) for y in range(8, 16, 2) for z in range(0, 8, 2)
    }
    assert {tuple(cell) for cell in of_four.lowest.tolist()} == {(0, y, z) for y in (16, 20) for z in (0, 4)}
    assert np.allclose(of_four.probability, 4 / (1 + np.exp(1.5)), atol=1e-4)
    assert len(of_eight.lowest) == 0


def test_unknown_space_is_not_shown(backend: str) -> None:
    """The prior of a line of eight voxels is above one half, but nothing was seen there."""
    unknown = map_of(backend, (0, 0, 0), np.full((8, 8, 8), -2.2))
    assert all_cells(unknown, 8).probability[0] > 0.5
    assert all(len(cells.lowest) == 0 for cells in standing_cells(unknown))


def test_nonsense_is_refused(hand: HandMap) -> None:
    with pytest.raises(ConfigError, match="side of 2, 4 or 8"):
        all_cells(hand, 3)
    with pytest.raises(ConfigError, match="between 0 and 1"):
        standing_cells(hand, 1.0)
