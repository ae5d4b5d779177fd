"""Frontiers and their clusters, against a search through every voxel of a box around the map."""

import numpy as np
import pytest
from hand_made import VOXEL
from queried_maps import HandMap, hand_map, map_of, room_map

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.box import map_extent, read_box
from taichi_mrf.queries.frontiers import find_frontiers


def by_search(m: HandMap, voxel_size: float) -> dict[tuple[int, ...], int]:
    """Frontier voxels with the number of their cluster, found by flooding."""
    lower, upper = map_extent(m)
    around = lower - 2 * voxel_size, upper + 2 * voxel_size
    found, state = read_box(m.marginals, *around), read_box(m, *around).state
    prior, least = m.view.pool.prior_log_odds, m.view.volume.min_evidence
    occupied = (found.log_odds > 0) & (np.abs(found.log_odds - prior) > least)
    explored = occupied | (found.log_odds < prior - least)  # by the marginals, whatever its state is
    frontier = set()
    for voxel in np.argwhere(state[1:-1, 1:-1, 1:-1] == 1) + 1:
        for axis in range(3):
            for step in (-1, 1):
                beside = voxel.copy()
                beside[axis] += step
                if state[tuple(beside)] == 0 and not explored[tuple(beside)]:
                    frontier.add(tuple((voxel + found.lowest).tolist()))
    cluster: dict[tuple[int, ...], int] = {}
    for number, seed in enumerate(sorted(frontier)):
        if seed in cluster:
            continue
        todo = [seed]
        cluster[seed] = number
        while todo:
            here = todo.pop()
            for step in np.ndindex(3, 3, 3):
                there = tuple(h + s - 1 for h, s in zip(here, step, strict=True))
                if there in frontier and there not in cluster:
                    cluster[there] = number
                    todo.append(there)
    return cluster


@pytest.mark.parametrize("which", ["hand", "mrf", "log_odds"])
def test_frontiers_are_those_that_a_search_finds(backend: str, which: str) -> None:
    m = hand_map(backend) if which == "hand" else room_map(which)
    found = find_frontiers(m)
    wanted = by_search(m, m.voxel_size)
    voxels = np.floor(found.points / m.voxel_size).astype(int)
    assert {tuple(v) for v in voxels.tolist()} == set(wanted)
    assert len(voxels) == len(wanted) > 500
    groups: dict[int, set[int]] = {}
    for voxel, number in zip(voxels.tolist(), found.cluster.tolist(), strict=True):
        groups.setdefault(number, set()).add(wanted[tuple(voxel)])
    assert all(len(group) == 1 for group in groups.values())
    assert len(groups) == len(set(wanted.values())) == len(found.sizes)
    assert (np.diff(found.sizes) <= 0).all()
    for number in range(min(len(found.sizes), 5)):
        mine = found.points[found.cluster == number]
        assert found.sizes[number] == len(mine)
        np.testing.assert_allclose(found.centroids[number], mine.mean(axis=0))


def test_across_the_border_of_chunks(backend: str) -> None:
    """A free plate on both sides of a corner of chunks, with the unknown above it: one cluster."""
    log_odds = np.full((16, 16, 8), -9.0)
    log_odds[:, :, 4:] = -2.2  # the prior
    m = map_of(backend, (-8, -8, 0), log_odds)
    found = find_frontiers(m)
    assert len(found.sizes) == 1
    assert {0, 3} <= set(np.floor(found.points[:, 2] / VOXEL).astype(int).tolist())
    assert found.sizes[0] == 16 * 16 * 4 - 14 * 14 * 2


def test_small_clusters_are_left_out(backend: str) -> None:
    """Three free places in the unknown, of 27, 8 and 1 voxels."""
    log_odds = np.full((16, 16, 16), -2.2)
    for corner, side in ((1, 3), (6, 2), (10, 1)):
        log_odds[(slice(corner, corner + side),) * 3] = -9.0
    m = map_of(backend, (0, 0, 0), log_odds)
    every, large = find_frontiers(m), find_frontiers(m, min_voxels=8)
    np.testing.assert_array_equal(every.sizes, [26, 8, 1])
    np.testing.assert_allclose(every.centroids, np.array([[2.5] * 3, [7.0] * 3, [10.5] * 3]) * VOXEL)
    np.testing.assert_array_equal(large.sizes, [26, 8])
    np.testing.assert_array_equal(large.points, every.points[every.cluster < 2])
    np.testing.assert_array_equal(large.cluster, every.cluster[every.cluster < 2])
    with pytest.raises(ConfigError, match="min_voxels must be at least 1"):
        find_frontiers(m, 0)


def test_nothing_free_has_no_frontier(backend: str) -> None:
    found = find_frontiers(map_of(backend, (0, 0, 0), np.full((8, 8, 8), 3.0)))
    assert (found.points.shape, found.cluster.shape, found.centroids.shape) == ((0, 3), (0,), (0, 3))
