"""Boxes, slices and the bricks that a map knows, against the voxels that were written and brute force."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import BRICK_M, VOXEL
from hypothesis import given
from hypothesis import strategies as st
from queried_maps import HandMap, hand_map, room, room_map

from taichi_mrf.errors import CapacityError, ConfigError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.box import MapSlice, map_extent, read_box, slice_map
from taichi_mrf.queries.known_bricks import (
    BrickReader,
    brick_centres,
    bricks_between,
    known_bricks,
    seen_free_bricks,
)
from taichi_mrf.queries.points import FREE
from taichi_mrf.voxels.layout import BRICK


def voxels_of(lowest: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.indices(shape).reshape(3, -1).T + lowest


@given(
    st.tuples(*[st.integers(-60, -10)] * 3),
    st.tuples(*[st.integers(2, 20)] * 3),
    st.floats(0.01, 0.99),
)
def test_a_box_holds_the_voxels_that_it_reaches_into(
    hand: HandMap, first: tuple[int, int, int], shape: tuple[int, int, int], share: float
) -> None:
    lower = np.array(first) + np.array([0, 40, 20])
    found = read_box(hand, (lower + share) * VOXEL, (lower + np.array(shape) - 1 + share) * VOXEL)
    assert found.lowest == tuple(lower)
    assert found.state.shape == shape
    voxels = voxels_of(np.array(found.lowest), found.state.shape)
    np.testing.assert_allclose(found.log_odds.ravel(), hand.true_log_odds(voxels), atol=2e-3)
    np.testing.assert_array_equal(found.state.ravel(), hand.true_state(voxels))
    np.testing.assert_array_equal(found.state.ravel(), hand.state((voxels + 0.5) * VOXEL))
    np.testing.assert_array_equal(found.occupancy.ravel(), hand.occupancy((voxels + 0.5) * VOXEL))


def test_corners_on_faces_take_no_voxel_more(hand: HandMap) -> None:
    found = read_box(hand, (0.15, 0.35, -0.1), (0.3, 0.8, 0.05))  # 0.15 / 0.05 is 2.9999999999999996
    assert found.lowest == (3, 7, -2)
    assert found.state.shape == (3, 9, 3)
    np.testing.assert_allclose(found.lower_m, (0.15, 0.35, -0.1))
    np.testing.assert_allclose(found.upper_m, (0.3, 0.8, 0.05))
    np.testing.assert_allclose(found.centres(0), (0.175, 0.225, 0.275))


@pytest.mark.parametrize(
    ("lower", "upper"), [((0, 0, 0), (1, 1, 0)), ((0, 0), (1, 1)), ((0, 0, 0), (1, np.nan, 1))]
)
def test_corners_that_make_no_box(hand: HandMap, lower: tuple, upper: tuple) -> None:
    with pytest.raises(ConfigError, match="a box needs"):
        read_box(hand, lower, upper)


def test_a_box_beyond_all_memory(hand: HandMap) -> None:
    with pytest.raises(CapacityError, match="million voxels"):
        read_box(hand, (-1e6, -1e6, -1e6), (1e6, 1e6, 1e6))


def test_seen_free_bricks_are_those_crossed_and_without_voxels(hand: HandMap) -> None:
    with_voxels = {tuple(b) for b in hand.hand.bricks.tolist()}
    expected = {tuple(b) for b in hand.crossed.tolist()} - with_voxels
    found = [tuple(b) for b in seen_free_bricks(hand).tolist()]
    assert len(expected) > 50
    assert found == sorted(expected)
    assert {tuple(b) for b in known_bricks(hand).tolist()} == expected | with_voxels


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("method", ["mrf", "log_odds", "visibility"])
def test_nothing_that_is_known_is_missed(method: str) -> None:
    """Against every brick in a box that reaches far beyond what the room's cameras can see."""
    m = room_map(method)
    everywhere = bricks_between(np.full(3, -14), np.full(3, 14))
    free = everywhere[m.state(brick_centres(everywhere, 0.1)) == FREE]
    without_voxels = free[BrickReader(m).slots(free) < 0]
    np.testing.assert_array_equal(seen_free_bricks(m), without_voxels)
    assert (len(without_voxels) > 10) == (method == "mrf")


@pytest.mark.usefixtures("backend")
def test_what_frozen_keyframes_have_seen_is_found() -> None:
    """Their cameras are forgotten; what they crossed hangs together with what is known."""
    m = room(MRFMap, range(2))
    before = seen_free_bricks(m)
    for id in list(m.keyframes):
        m.freeze_keyframe(id)
    assert len(before) > 10
    np.testing.assert_array_equal(seen_free_bricks(m), before)


def test_the_extent_ends_at_the_outermost_bricks(hand: HandMap) -> None:
    every = np.concatenate([hand.hand.bricks, hand.crossed])
    lower, upper = map_extent(hand)
    np.testing.assert_allclose(lower, every.min(axis=0) * BRICK_M)
    np.testing.assert_allclose(upper, (every.max(axis=0) + 1) * BRICK_M)


@pytest.mark.usefixtures("backend")
def test_an_empty_map_has_no_extent() -> None:
    m = MRFMap(0.1)
    assert len(known_bricks(m)) == 0
    with pytest.raises(ConfigError, match="the map is empty"):
        map_extent(m)


@pytest.mark.parametrize(("axis", "order"), [("x", "yz"), ("y", "xz"), ("z", "xy")])
def test_slices_are_layers_of_the_map(hand: HandMap, axis: str, order: str) -> None:
    cut = slice_map(hand, {"x": -1.31, "y": 1.42, "z": -0.33}[axis], axis)  # type: ignore[arg-type]
    assert (cut.across, cut.up) == tuple(order)
    left, right, bottom, top = cut.extent
    rows, columns = cut.state.shape
    assert (rows, columns) == (round((top - bottom) / VOXEL), round((right - left) / VOXEL))
    across, up = np.meshgrid(
        left + (np.arange(columns) + 0.5) * VOXEL, bottom + (np.arange(rows) + 0.5) * VOXEL
    )
    points = np.full((rows * columns, 3), cut.at_m)
    points[:, "xyz".index(cut.across)], points[:, "xyz".index(cut.up)] = across.ravel(), up.ravel()
    np.testing.assert_array_equal(cut.occupancy.ravel(), hand.occupancy(points))
    np.testing.assert_array_equal(cut.state.ravel(), hand.state(points))
    assert {0, 1, 2} == set(np.unique(cut.state))
    whole = map_extent(hand)
    assert (left, right) == pytest.approx([corner["xyz".index(cut.across)] for corner in whole])


def test_cuts_of_a_map_whose_y_points_down(backend: str) -> None:
    flipped = replace(hand_map(backend), keyframes={0: SimpleNamespace(T_world_camera=np.eye(4))})
    level, below = slice_map(flipped, -1.42), slice_map(flipped, 1.42, "y")
    assert (level.across, level.up, level.axis) == ("x", "z", "y")
    assert level.at_m == below.at_m == pytest.approx(1.425)
    points = cell_centres(level)
    np.testing.assert_array_equal(level.state.ravel(), flipped.state(points))
    upright = slice_map(flipped, -1.31, "x")
    assert (upright.across, upright.up) == ("z", "y")
    assert upright.extent[2] > upright.extent[3]  # the first row is the lowest: it has the largest y
    np.testing.assert_array_equal(upright.state.ravel(), flipped.state(cell_centres(upright)))


def cell_centres(cut: MapSlice) -> np.ndarray:
    """The centres (rows * columns, 3) of a cut's voxels, row by row, from its extent."""
    rows, columns = cut.state.shape
    left, right, bottom, top = cut.extent
    across = left + (np.arange(columns) + 0.5) * (right - left) / columns
    up = bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows
    points = np.full((rows, columns, 3), cut.at_m)
    points[..., "xyz".index(cut.across)] = across
    points[..., "xyz".index(cut.up)] = up[:, None]
    return points.reshape(-1, 3)


def test_a_part_of_a_slice(hand: HandMap) -> None:
    cut = slice_map(hand, -0.33, "z", (-1.6, 1.0), (-1.2, 1.5))
    assert cut.extent == pytest.approx((-1.6, -1.2, 1.0, 1.5))
    assert cut.state.shape == (10, BRICK)


def test_slices_that_cannot_be(hand: HandMap) -> None:
    with pytest.raises(ConfigError, match="axis must be up, x, y or z, not 'w'"):
        slice_map(hand, 0.0, "w")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="finite position along up"):
        slice_map(hand, np.nan)
    with pytest.raises(ConfigError, match="two numbers"):
        slice_map(hand, 0.0, "z", (0, 0, 0), (1, 1, 1))
