"""Floor plans as judges: where they lie, and precision, recall and overlap on hand-made grids."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.datasets.laser.floor_plan_scans import FloorPlanOptions, simulate_scans
from taichi_mrf.datasets.laser.readers import open_scans
from taichi_mrf.datasets.laser.scans import FloorPlan, LaserScans, read_floor_plan
from taichi_mrf.errors import DatasetError
from taichi_mrf.evaluation.floor_plan import (
    FREE,
    HIDDEN,
    OCCUPIED,
    LaserMap,
    floor_plan_scores,
    register,
    true_cells,
)


def a_map(occupied: list[str], unseen: str = "?", cell_size: float = 1.0) -> LaserMap:
    """A map from a drawing: '#' occupied, '.' free, '?' unseen; the last line is the lowest row."""
    drawn = np.array([list(line) for line in occupied[::-1]])
    return LaserMap(drawn == "#", drawn != unseen, None, cell_size, (0, 0))


def truth(lines: list[str]) -> np.ndarray:
    """'#' wall, '.' free, ' ' hidden."""
    drawn = np.array([list(line) for line in lines[::-1]])
    return np.where(drawn == "#", OCCUPIED, np.where(drawn == ".", FREE, HIDDEN)).astype(np.int8)


ROOM = ["######", "#....#", "#....#", "#....#", "######"]


def test_the_truth_itself_is_right() -> None:
    for within in (0, 1):
        scores = floor_plan_scores(a_map(ROOM), truth(ROOM), within)
        for kind in (scores.occupied, scores.free):
            assert (kind.precision, kind.recall, kind.iou) == (1, 1, 1)
    assert scores.cells == 30


def test_exact_counts_on_a_hand_made_grid() -> None:
    found = a_map(["##.###", "#....#", "#.#..#", "#....?", "######"])
    scores = floor_plan_scores(found, truth(ROOM), within=0)
    # Occupied: 18 walls, one of which is called free and one unseen; one free cell is called occupied.
    assert scores.occupied.precision == pytest.approx(16 / 17)
    assert scores.occupied.recall == pytest.approx(16 / 17)
    assert scores.occupied.iou == pytest.approx(16 / 18)
    assert scores.free.precision == pytest.approx(11 / 12)
    assert scores.free.recall == pytest.approx(11 / 12)
    assert scores.free.iou == pytest.approx(11 / 13)
    assert scores.cells == 29


def test_within_one_cell_neighbours_count_also_diagonally() -> None:
    lines = ["......", "......", "..#...", "......", "......"]
    near = a_map(["......", "...#..", "......", "......", "......"])
    far = a_map(["....#.", "......", "......", "......", "......"])
    assert floor_plan_scores(near, truth(lines), within=0).occupied.iou == 0
    assert floor_plan_scores(near, truth(lines)).occupied.iou == 1
    assert floor_plan_scores(far, truth(lines)).occupied.iou == 0
    assert floor_plan_scores(far, truth(lines), within=2).occupied.iou == 1


def test_hidden_cells_may_be_occupied_but_not_free() -> None:
    plan = truth(["      ", "      ", "######", "......"])
    solid = floor_plan_scores(a_map(["######", "######", "######", "......"]), plan)
    assert solid.occupied.precision == 1
    assert solid.free.precision == 1
    hollow = floor_plan_scores(a_map(["......", "......", "######", "......"]), plan)
    assert hollow.free.precision == pytest.approx(6 / 18)  # free cells two off the nearest free one
    assert hollow.occupied.precision == 1


def test_nothing_to_judge_is_nan_and_nothing_found_is_zero() -> None:
    nothing = floor_plan_scores(a_map(["???"]), truth(["###"]))
    assert nothing.cells == 0
    assert math.isnan(nothing.occupied.precision)
    assert math.isnan(nothing.occupied.iou)
    missed = floor_plan_scores(a_map(["..."]), truth(["###"]))
    assert math.isnan(missed.occupied.precision)
    assert missed.occupied.recall == 0
    assert missed.occupied.iou == 0


@given(seed=st.integers(0, 200), rows=st.integers(1, 8), columns=st.integers(1, 8))
def test_scores_without_tolerance_are_set_arithmetic(seed: int, rows: int, columns: int) -> None:
    random = np.random.default_rng(seed)
    found, seen = random.random((2, rows, columns)) < 0.6
    plan = random.integers(0, 2, (rows, columns)).astype(np.int8)
    scores = floor_plan_scores(LaserMap(found, seen, None, 1.0, (0, 0)), plan, within=0)
    for kind, label, true in (
        (scores.occupied, found & seen, (plan == OCCUPIED) & seen),
        (scores.free, ~found & seen, (plan == FREE) & seen),
    ):
        both, either = int((label & true).sum()), int((label | true).sum())
        expected = (
            both / label.sum() if label.any() else math.nan,
            both / true.sum() if true.any() else math.nan,
            both / either if either else math.nan,
        )
        assert (kind.precision, kind.recall, kind.iou) == pytest.approx(expected, nan_ok=True)


def test_cells_of_a_plan_in_the_frame_of_the_map() -> None:
    # 10 x 6 pixels of 0.5 m with the lower left corner at (-1, -2); a closed box fills the right half.
    wall = np.zeros((6, 10), dtype=bool)
    wall[[0, -1], 5:] = wall[:, [5, 9]] = True
    plan = FloorPlan(wall, (-1.0, -2.0), (0.5, 0.5))
    found = LaserMap(np.zeros((4, 7), bool), np.ones((4, 7), bool), None, 1.0, (-2, -2))
    cells = true_cells(plan, found, np.array([[0.0, 0.0]]))
    assert cells.tolist() == [
        [HIDDEN, FREE, FREE, OCCUPIED, OCCUPIED, OCCUPIED, HIDDEN],
        [HIDDEN, FREE, FREE, OCCUPIED, HIDDEN, OCCUPIED, HIDDEN],
        [HIDDEN, FREE, FREE, OCCUPIED, OCCUPIED, OCCUPIED, HIDDEN],
        [HIDDEN] * 7,
    ]


@pytest.mark.parametrize("cell_size", [0.01, 0.05, 0.18])
def test_a_thin_wall_is_in_its_cells_at_every_cell_size(cell_size: float) -> None:
    wall = np.zeros((100, 100), dtype=bool)
    wall[:, 50] = True
    plan = FloorPlan(wall, (0.0, 0.0), (0.03, 0.03))
    count = int(3.0 / cell_size)
    shape = (count, count)
    found = LaserMap(np.zeros(shape, bool), np.ones(shape, bool), None, cell_size, (0, 0))
    cells = true_cells(plan, found, np.array([[0.1, 0.1]]))
    column = int(1.515 / cell_size)
    assert (cells[:, column] == OCCUPIED).all()
    assert (cells[:, : int(1.4 / cell_size)] == FREE).all()
    assert (cells[:, int(1.6 / cell_size) + 1 :] == HIDDEN).all()


@pytest.fixture(scope="module")
def simulated() -> LaserScans:
    return simulate_scans(FloorPlanOptions(scans=60))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.12, -0.2), (-0.28, 0.04), (0.0, 0.3)])
def test_a_shifted_plan_is_put_right(simulated: LaserScans, shift: tuple[float, float]) -> None:
    assert simulated.floor_plan is not None
    found = register(simulated.floor_plan.moved(*shift), simulated)
    assert found.plan.lower_x_y == pytest.approx(simulated.floor_plan.lower_x_y, abs=0.021)
    assert found.shift_x_y == pytest.approx((-shift[0], -shift[1]), abs=0.021)
    assert not found.walled_edge
    if shift != (0.0, 0.0):
        assert found.on_walls > found.on_walls_unshifted
    assert f"{100 * found.on_walls:.1f}%" in found.text()


def test_an_edge_that_stops_beams_is_a_wall(simulated: LaserScans) -> None:
    plan = simulated.floor_plan
    assert plan is not None
    inner = FloorPlan(plan.wall[10:-10, 10:-10], (-6.8, -4.8), plan.pixel_x_y)
    assert not inner.wall[0].all()  # the outer walls are cut off
    found = register(inner, simulated)
    assert found.walled_edge
    assert found.plan.wall[0].all()
    assert found.plan.wall[:, -1].all()
    assert found.beyond_edge > 0.01


def test_a_plan_is_read_from_an_image(tmp_path: Path) -> None:
    image = np.full((4, 8), 255, dtype=np.uint8)
    image[0, 1] = 0
    cv2.imwrite(str(tmp_path / "plan.png"), image)
    plan = read_floor_plan(tmp_path / "plan.png", (4.0, 2.0))
    assert plan.lower_x_y == (-2.0, -1.0)
    assert plan.upper_x_y == (2.0, 1.0)
    row, column = plan.pixels(np.array([-1.3, 0.9]))
    assert bool(plan.wall[row, column])
    assert plan.wall.sum() == 1


def test_plans_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "plan.png").write_bytes(b"no image")
    (tmp_path / "empty.png").write_bytes(b"")
    for name in ("plan.png", "empty.png", "nowhere.png"):
        with pytest.raises(DatasetError, match=name):
            read_floor_plan(tmp_path / name, (1.0, 1.0))
    with pytest.raises(DatasetError, match="size"):
        read_floor_plan(tmp_path / "plan.png", (0.0, 1.0))


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "size", "share", "walled"),
    [("cave_player", (16.0, 16.0), 0.6, True), ("hospital_section_player", (45.25, 18.45), 0.7, False)],
)
def test_player_centres_its_plans(
    shared_data: Path, name: str, size: tuple[float, float], share: float, walled: bool
) -> None:
    """Found by the beams' ends alone: both lie within two pixels of the scans' origin."""
    folder = shared_data / "laser2d" / name
    plan = read_floor_plan(folder / "floorplan.png", size)
    found = register(plan, open_scans(folder))
    assert np.abs(found.shift_x_y).max() < 2 * max(plan.pixel_x_y)
    assert found.on_walls > share
    assert found.walled_edge == walled
    mirrored = register(FloorPlan(plan.wall[::-1], plan.lower_x_y, plan.pixel_x_y), open_scans(folder))
    assert mirrored.on_walls < found.on_walls / 2
