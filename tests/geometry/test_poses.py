"""Poses: what is accepted, what is refused with which words, and the norms that select keyframes."""

import warnings
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose, inverse, look_at, rotation_angle, tangent_norms

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

coordinates = st.lists(st.floats(-100, 100), min_size=3, max_size=3).map(np.array)
angles = st.floats(0.0, np.pi)


def rotation_about(axis: Vector, angle: float) -> Matrix:
    """Rodrigues' formula, as an oracle."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


axes = coordinates.filter(lambda axis: np.linalg.norm(axis) > 1e-3)
poses = st.builds(
    lambda axis, angle, t: np.vstack(
        [np.column_stack([rotation_about(axis, angle), t]), [0.0, 0.0, 0.0, 1.0]]
    ),
    axes,
    angles,
    coordinates,
)


@given(poses)
def test_a_pose_passes_unchanged_in_both_shapes(T: Pose) -> None:
    np.testing.assert_allclose(as_pose(T), T, atol=1e-9)
    np.testing.assert_array_equal(as_pose(T[:3]), as_pose(T))


@given(poses, st.integers(0, 2**32 - 1))
def test_a_nearly_orthonormal_rotation_is_projected(T: Pose, seed: int) -> None:
    noisy = T.copy()
    noisy[:3, :3] += np.random.default_rng(seed).uniform(-5e-4, 5e-4, (3, 3))
    R = as_pose(noisy)[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.abs(R - T[:3, :3]).max() < 2e-3


def test_projection_leaves_the_callers_matrix_alone() -> None:
    T = np.eye(4)
    T[0, 0] = 1.001
    as_pose(T)
    assert T[0, 0] == 1.001


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda T: T.__setitem__((0, 3), np.nan), "not finite"),
        (lambda T: T.__setitem__((1, 1), np.inf), "not finite"),
        (lambda T: T.__setitem__((3, 0), 0.5), "last row"),
        (lambda T: T.__setitem__((0, 0), 1.2), "not one"),
        (lambda T: T.__setitem__((0, 0), -1.0), "reflection"),
    ],
)
def test_what_is_no_pose_is_refused_with_the_reason(change: Callable[[Pose], None], words: str) -> None:
    T = np.eye(4)
    change(T)
    with pytest.raises(KeyframeError, match=words):
        as_pose(T)


@pytest.mark.parametrize("T", [np.eye(3), np.zeros(16), "pose", [[1, 2], [3]]])
def test_what_is_no_matrix_is_refused(T: object) -> None:
    with pytest.raises(KeyframeError):
        as_pose(T)  # type: ignore[arg-type]


@given(poses)
def test_inverse_undoes_a_pose(T: Pose) -> None:
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-9)


@given(axes, st.floats(1e-7, np.pi))
def test_rotation_angle_keeps_its_digits(axis: Vector, angle: float) -> None:
    # Near pi the matrix determines the angle only to the root of the rounding error.
    assert rotation_angle(rotation_about(axis, angle)) == pytest.approx(angle, rel=1e-6, abs=1e-8)


@given(poses, poses)
def test_tangent_norms_are_symmetric_and_zero_for_the_same_pose(T_world_a: Pose, T_world_b: Pose) -> None:
    there, back = tangent_norms(T_world_a, T_world_b), tangent_norms(T_world_b, T_world_a)
    np.testing.assert_allclose(there, back, atol=1e-7)
    np.testing.assert_allclose(there[1], np.linalg.norm(T_world_a[:3, 3] - T_world_b[:3, 3]), atol=1e-9)
    np.testing.assert_allclose(tangent_norms(T_world_a, T_world_a), 0.0, atol=1e-7)


@given(coordinates, coordinates)
def test_look_at_points_the_optical_axis_at_the_target(eye: Vector, target: Vector) -> None:
    distance = np.linalg.norm(target - eye)
    if distance < 1e-3:
        return
    T_world_camera = look_at(eye, target)
    R = T_world_camera[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R[:, 2] * distance, target - eye, atol=1e-9 * max(1.0, distance))


def test_look_at_keeps_the_image_upright_and_looks_straight_down_too() -> None:
    assert look_at((0, 0, 1), (1, 0, 1))[2, 1] == pytest.approx(-1.0)  # image down is world down
    R = look_at((0, 0, 2), (0, 0, 0))[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)


def test_a_damaged_pose_far_away_is_far_without_a_warning() -> None:
    far = np.eye(4)
    far[0, 3] = 1e300
    with np.errstate(over="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert tangent_norms(np.eye(4), far)[1] > 1e9
