"""Errors of trajectories: closed forms, and what no rigid motion of everything changes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.errors import ArgumentError
from taichi_mrf.evaluation.trajectory_error import (
    Trajectory,
    associated,
    rigid_alignment,
    step_errors,
    trajectory_error,
)
from taichi_mrf.geometry.poses import Pose

motions = st.lists(st.floats(-2, 2), min_size=6, max_size=6)


def at(x: float, y: float = 0.0, z: float = 0.0) -> Pose:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def walk(seed: int, count: int = 12) -> dict[float, Pose]:
    random = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(moved(poses[-1], random.normal(0.0, 0.3, 6)))
    return {i / 10: T for i, T in enumerate(poses)}


def test_a_drift_along_a_line_in_closed_form() -> None:
    """Four metres that are measured as four times 1.1 metres."""
    true = {float(i): at(i) for i in range(5)}
    error = trajectory_error({float(i): at(1.1 * i) for i in range(5)}, true)
    # Anchored, frame i is off by 0.1 i; aligned, by 0.1 (i - 2).
    assert error.frames == 5
    assert error.anchored_rms_m == pytest.approx(0.1 * math.sqrt(30 / 5))
    assert error.anchored_largest_m == error.end_m == pytest.approx(0.4)
    assert error.end_rad == pytest.approx(0.0)
    assert error.rms_m == pytest.approx(0.1 * math.sqrt(10 / 5))
    assert error.largest_m == pytest.approx(0.2)


def test_a_wrong_heading_at_the_start_is_an_error_of_the_anchored_trajectory_alone() -> None:
    true = {float(i): at(i, 0.1 * i * i) for i in range(4)}
    c, s = math.cos(0.3), math.sin(0.3)
    turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    estimated = {0.0: true[0.0]} | {i: turn @ true[i] for i in (1.0, 2.0, 3.0)}
    error = trajectory_error(estimated, true)
    assert error.rms_m == pytest.approx(0.0, abs=1e-12)
    assert error.end_m == pytest.approx(2 * math.sin(0.15) * math.hypot(3, 0.9))
    assert error.end_rad == pytest.approx(0.3)


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), of_all=motions, of_estimated=motions)
def test_a_rigid_motion_of_everything_changes_nothing(
    seed: int, of_all: list[float], of_estimated: list[float]
) -> None:
    true, other = walk(seed), walk(seed + 1)
    noisy = {key: moved(T, 0.05 * np.ones(6) * key) for key, T in true.items()}
    T_all, T_estimated = moved(np.eye(4), of_all), moved(np.eye(4), of_estimated)
    for estimated in (noisy, other):
        before = trajectory_error(estimated, true)
        both = trajectory_error(_by(T_all, estimated), _by(T_all, true))
        ours = trajectory_error(_by(T_estimated, estimated), true)
        for name in ("rms_m", "largest_m", "anchored_rms_m", "anchored_largest_m", "end_m", "end_rad"):
            expected = pytest.approx(getattr(before, name), abs=1e-7)
            assert getattr(both, name) == expected
            assert getattr(ours, name) == expected  # the frame that an estimate is in says nothing
        steps = step_errors(_by(T_estimated, estimated), true)
        assert list(steps.values()) == pytest.approx(list(step_errors(estimated, true).values()), abs=1e-7)


def _by(T: Pose, trajectory: Trajectory) -> dict[float, Pose]:
    return {key: T @ pose for key, pose in trajectory.items()}


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), xi=motions)
def test_no_other_motion_fits_better(seed: int, xi: list[float]) -> None:
    random = np.random.default_rng(seed)
    points, onto = random.normal(size=(2, 7, 3))
    T = rigid_alignment(points, onto)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)

    def squares(motion: Pose) -> float:
        return float(((points @ motion[:3, :3].T + motion[:3, 3] - onto) ** 2).sum())

    assert squares(T) <= squares(moved(T, 0.1 * np.array(xi))) + 1e-9


def test_a_mirror_image_is_not_reached_by_a_reflection() -> None:
    points = np.random.default_rng(1).normal(size=(9, 3))
    T = rigid_alignment(points, points * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_poses_are_compared_by_stamp() -> None:
    true = {0.0: at(0), 1.0: at(1), 2.0: at(2)}
    estimated = {0.01: at(0), 1.02: at(1), 1.9: at(5)}
    assert list(associated(estimated, true, 0.05)) == [0.01, 1.02]
    assert trajectory_error(estimated, true, 0.05).rms_m == pytest.approx(0.0, abs=1e-12)
    assert trajectory_error(estimated, true, 0.2).frames == 3
    for nothing in (associated(estimated, true), associated(estimated, {}), associated({}, true)):
        assert nothing == {}
    with pytest.raises(ArgumentError, match="none of its poses"):
        trajectory_error(estimated, true)


def test_a_step_error_is_where_the_drift_arises() -> None:
    """Frame 3 jumps by 20 cm, and frame 4 is lost."""
    true = {float(i): at(i) for i in range(7)}
    estimated = {float(i): at(i + 0.2 * (i >= 3)) for i in (0, 1, 2, 3, 5, 6)}
    steps = step_errors(estimated, true)
    assert list(steps) == [1.0, 2.0, 3.0, 5.0, 6.0]
    assert {key for key, error in steps.items() if error > 1e-9} == {3.0}
    assert steps[3.0] == pytest.approx(0.2)
