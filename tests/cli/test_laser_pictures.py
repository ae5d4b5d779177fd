"""Pictures of laser maps: what is drawn where, read from the figures themselves."""

import numpy as np
import pytest

from taichi_mrf.datasets.laser.scans import FloorPlan
from taichi_mrf.evaluation.floor_plan import LaserMap
from taichi_mrf.evaluation.pictures.laser_pictures import (
    METHOD_NAMES,
    comparison_figure,
    energy_figure,
    map_figure,
)
from taichi_mrf.factor_graph.solve import METHODS

PATH = np.array([[0.0, 0.0], [0.5, 0.2], [1.0, 0.0]])


def a_map(marginals: bool = False) -> LaserMap:
    occupied = np.array([[True, False, False], [False, False, False]])
    seen = np.array([[True, True, False], [True, True, True]])
    probability = np.full((2, 3), 0.25, dtype=np.float32) if marginals else None
    return LaserMap(occupied, seen, probability, 0.5, (-2, 3))


def test_a_map_knows_where_it_lies() -> None:
    assert a_map().lower_x_y == (-1.0, 1.5)
    assert a_map().extent == (-1.0, 0.5, 1.5, 2.5)


@pytest.mark.parametrize("marginals", [False, True])
def test_dark_is_occupied_and_grey_unknown(marginals: bool) -> None:
    axes = map_figure(a_map(marginals), PATH, "a map").axes[0]
    (image,) = axes.get_images()
    shown = np.asarray(image.get_array())
    assert shown[0, 2] == pytest.approx(0.8)
    assert shown[0, 0] == pytest.approx(0.75 if marginals else 0.0)
    assert shown[1, 1] == pytest.approx(0.75 if marginals else 1.0)
    assert tuple(image.get_extent()) == (-1.0, 0.5, 1.5, 2.5)
    assert image.origin == "lower"
    assert np.array_equal(axes.get_lines()[0].get_xydata(), PATH)
    assert axes.get_title() == "a map"


def test_every_method_has_a_curve_and_a_one_step_method_a_level_line() -> None:
    traces = {
        "inverse": [(0.1, 300.0)],
        "dd": [(0.1, 900.0), (2.0, 200.0)],
        "bp": [(0.2, 500.0), (1.0, 250.0)],
    }
    duals = {"dd": [(0.1, -50.0), (2.0, 190.0)], "inverse": [], "bp": []}
    axes, below = energy_figure(traces, duals, "cave").axes
    labels = [line.get_label() for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
    assert labels == ["inverse sensor model", "dual decomposition", "belief propagation"]
    assert list(axes.get_lines()[0].get_ydata()) == [300.0, 300.0]
    assert axes.get_lines()[1].get_xydata().tolist() == [[0.1, 900.0], [2.0, 200.0]]
    low, high = axes.get_ylim()
    assert low < 200 < 300 < high < 500  # all ends are seen, and no more than that
    assert axes.get_xlim()[1] > 2.0
    (bound,) = below.get_lines()
    assert bound.get_xydata().tolist() == [[0.1, -50.0], [2.0, 190.0]]
    assert bound.get_color() == axes.get_lines()[1].get_color()


def test_a_method_alone_is_shown_from_its_first_energy_on() -> None:
    (axes,) = energy_figure({"bp": [(0.1, 900.0), (2.0, 200.0)]}, {"bp": []}, "cave").axes
    low, high = axes.get_ylim()
    assert low < 200 < 900 < high


def test_figures_of_nothing_can_be_drawn() -> None:
    assert energy_figure({}, {}, "nothing").axes
    assert energy_figure({"inverse": [(0.0, 0.0)]}, {}, "zero").axes


@pytest.mark.parametrize("plan", [None, FloorPlan(np.eye(4, dtype=bool), (0.0, 0.0), (0.5, 0.5))])
def test_all_maps_stand_beside_the_plan(plan: FloorPlan | None) -> None:
    figure = comparison_figure({method: a_map() for method in METHODS}, PATH, plan)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[0] == ("path of the robot" if plan is None else "floor plan and path")
    assert titles[1:] == [METHOD_NAMES[method] for method in METHODS]
    assert len(figure.axes[0].get_images()) == (0 if plan is None else 1)
    assert all(axes.get_xlim() == (-1.0, 0.5) for axes in figure.axes)
