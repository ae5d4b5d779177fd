"""The energy of any labelling, for both sensor models."""

import numpy as np
import pytest
from factor_graph_scenes import CELL, beams_of, room_beams
from oracles import factor_graph as reference

from taichi_mrf.errors import ConfigError
from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import build_graph
from taichi_mrf.factor_graph.potentials import UNITS, energy, judged

pytestmark = pytest.mark.usefixtures("backend")


@pytest.mark.parametrize("sensor", ["piecewise", "gaussian"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 1.0])
def test_the_energy_of_a_labelling_is_the_oracles(sensor: str, share: float) -> None:
    beams = room_beams()
    graph = build_graph(beams, CELL)
    config = LaserConfig(sensor=sensor, sigma=0.3)  # type: ignore[arg-type]
    labels = (np.random.default_rng(2).random(graph.grid.cells) < share).astype(np.uint8)
    expected = reference.energy(reference.factors_of(beams, graph.grid, config), labels)
    # Each beam's energy is rounded to a unit once, and float32 knows a thousand to 1e-4.
    assert energy(graph, config, labels) == pytest.approx(expected, abs=len(beams) * (1 / UNITS + 1e-4))


def test_the_three_cases_of_equation_26() -> None:
    graph = build_graph(beams_of([(0.1, 0.1, 0.0, 1.7, True), (0.1, 0.6, 0.0, 1.7, False)]), CELL)
    config = LaserConfig()
    cells = graph.cells.to_numpy().reshape(2, 4)
    labels = np.zeros(graph.grid.cells, np.uint8)
    assert judged(graph, config, labels) == (900 + 1, 0.5)
    labels[cells[0, 3]] = 1
    assert judged(graph, config, labels) == (1 + 1, 1.0)
    labels[cells[0, 1]] = 1
    assert judged(graph, config, labels) == (1000 + 1, 0.5)
    labels[cells[1, 3]] = 1
    assert judged(graph, config, labels) == (1000 + 1000, 0.0)


def test_a_parameter_outside_its_range_is_named() -> None:
    for name, value in {"cell_size": 0.0, "damping": 1.0, "energy_free": 1e5, "chains": 0}.items():
        with pytest.raises(ConfigError, match=f"laser.{name}"):
            LaserConfig(**{name: value})  # type: ignore[arg-type]
