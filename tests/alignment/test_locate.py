"""Directions that depth determines badly do not carry a camera far away from where it was expected."""

import numpy as np
import pytest

from taichi_mrf.alignment import locate
from taichi_mrf.alignment.levenberg import Aligned
from taichi_mrf.alignment.point_to_plane import NormalEquations
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, tangent_norms

GUESS = moved(np.eye(4), [1.0, 2.0, 0.5, 0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("all_m", "well_m", "taken_m"),
    [
        ((0.0, 0.05, 0.0), (0.0, 0.0, 0.0), (0.0, 0.05, 0.0)),  # near the guess
        ((0.2, 0.03, 0.0), (0.2, 0.0, 0.0), (0.2, 0.03, 0.0)),  # far, and so it is along the others
        ((0.02, 0.3, 0.0), (0.02, 0.0, 0.0), (0.02, 0.0, 0.0)),  # far by the bad ones alone
    ],
)
def test_badly_determined_directions_count_where_they_change_little(
    monkeypatch: pytest.MonkeyPatch,
    all_m: tuple[float, ...],
    well_m: tuple[float, ...],
    taken_m: tuple[float, ...],
) -> None:
    equations = NormalEquations(np.eye(6), np.zeros(6), 1.0, 0.0, 1, 1, 0.0)

    def ended(levels: object, T: Pose, prior: object, lever_m: float, observable: float) -> Aligned:
        step = all_m if observable < RULES.observable_by_depth else well_m
        return Aligned(moved(T, [*step, 0.0, 0.0, 0.0]), equations, 6)

    monkeypatch.setattr(locate, "aligned", ended)
    end = locate._not_carried_away([], GUESS, Recorded(GUESS, PoseConfig()), 1.0, RULES.observable)
    assert tangent_norms(end.T_world_camera, moved(GUESS, [*taken_m, 0.0, 0.0, 0.0]))[1] < 1e-9
