"""Which cells beams cross, and the lists of both sides."""

import numpy as np
import pytest
from factor_graph_scenes import CELL, beams_of, random_beams, room_beams
from oracles.factor_graph import cells_of

from taichi_mrf.errors import CapacityError, DatasetError
from taichi_mrf.factor_graph.beams import Beams, Grid
from taichi_mrf.factor_graph.graph import build_graph

pytestmark = pytest.mark.usefixtures("backend")


def test_the_cells_of_each_beam_are_those_of_the_oracle_in_their_order() -> None:
    beams = room_beams()
    graph = build_graph(beams, CELL)
    begins, cells = graph.begins.to_numpy(), graph.cells.to_numpy()
    for f in range(len(beams)):
        assert cells[begins[f] : begins[f + 1]].tolist() == cells_of(beams, f, graph.grid)
    assert graph.edges == begins[-1] == len(cells)
    assert graph.longest == np.diff(begins).max()


def test_beams_in_three_dimensions() -> None:
    random = np.random.default_rng(1)
    directions = random.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    beams = Beams(
        random.uniform(-3, 3, (200, 3)), directions, random.uniform(0.1, 4, 200).astype(np.float32),
        random.random(200) < 0.5,
    )  # fmt: skip
    graph = build_graph(beams, 0.3)
    begins, cells = graph.begins.to_numpy(), graph.cells.to_numpy()
    same = sum(
        cells[begins[f] : begins[f + 1]].tolist() == cells_of(beams, f, graph.grid) for f in range(200)
    )
    assert same >= 198  # float32 may cut another way past an edge
    assert graph.grid.image(np.zeros(graph.grid.cells)).shape == graph.grid.shape


def test_the_beams_of_each_cell_are_the_same_edges_seen_from_the_other_side() -> None:
    graph = build_graph(room_beams(), CELL)
    begins, cells = graph.begins.to_numpy(), graph.cells.to_numpy()
    lists = graph.lists
    cell_begins, beams, steps = (a.to_numpy() for a in (lists.begins, lists.beams, lists.steps))
    cell = np.repeat(np.arange(graph.grid.cells), np.diff(cell_begins))
    np.testing.assert_array_equal(cells[begins[beams] + steps], cell)
    assert len(np.unique(beams.astype(np.int64) * graph.grid.cells + cell)) == graph.edges
    np.testing.assert_array_equal(np.diff(cell_begins), graph.degrees.to_numpy())
    np.testing.assert_array_equal(graph.connected, np.isin(np.arange(graph.grid.cells), cells))


def test_a_beam_within_one_cell_and_no_beams_at_all() -> None:
    graph = build_graph(beams_of([(0.1, 0.1, 0.3, 0.2, True)]), CELL)
    assert graph.edges == graph.longest == 1
    assert graph.connected.sum() == 1
    empty = build_graph(beams_of([]), CELL)
    assert (empty.beams, empty.edges) == (0, 0)
    assert not empty.connected.any()


def test_an_image_has_x_to_the_right_and_y_upwards() -> None:
    graph = build_graph(beams_of([(0.1, 0.1, 0.0, 1.7, True)]), CELL)
    rows, columns = np.nonzero(graph.grid.image(graph.connected))
    assert len(set(rows.tolist())) == 1
    assert columns.tolist() == list(range(columns[0], columns[0] + 4))


def test_cells_are_aligned_to_the_world() -> None:
    grid = Grid.around(random_beams(3, 5), CELL)
    np.testing.assert_allclose(grid.to_cells(np.array([[0.0, 0.0, 0.0]])), [[-v for v in grid.lower]])


def test_too_much_memory_is_refused_before_it_is_taken() -> None:
    with pytest.raises(CapacityError, match=r"540 beams.*would need .* GB .*cell size"):
        build_graph(room_beams(), CELL, memory_limit_gb=1e-5)
    with pytest.raises(CapacityError, match="cells"):
        build_graph(room_beams(), 1e-6)


@pytest.mark.parametrize("broken", [np.nan, np.inf, -1.0, 0.0])
def test_a_range_that_is_none_is_refused(broken: float) -> None:
    with pytest.raises(DatasetError, match="beam 1 "):
        beams_of([(0, 0, 0, 1, True), (0, 0, 0, broken, True)])
