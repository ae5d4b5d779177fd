"""The pose graph against SciPy's least squares, its robust kernel against wrong loops, and its sparse
equations against dense ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from taichi_mrf.alignment.pose_equations import PoseEquations
from taichi_mrf.alignment.pose_graph import solve_pose_graph
from taichi_mrf.alignment.se3 import moved, twist
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms

SIGMAS = np.array([0.01, 0.02, 0.015, 0.004, 0.005, 0.006])


def ring(count: int) -> dict[int, Pose]:
    """Cameras around a circle of one metre, looking along it."""
    poses = {0: np.eye(4)}
    for i in range(1, count):
        poses[i] = moved(poses[i - 1], [2 * np.pi / count, 0, 0, 0, 2 * np.pi / count, 0])
    return poses


def information(random: np.random.Generator) -> np.ndarray:
    """Correlated, as alignments have it."""
    mixed = random.normal(size=(6, 6)) * 0.2 + np.eye(6)
    return mixed.T @ np.diag(SIGMAS**-2.0) @ mixed


def measured(
    poses: dict[int, Pose], i: int, k: int, random: np.random.Generator, certain: bool = True
) -> PoseEdge:
    step = moved(inverse(poses[i]) @ poses[k], random.normal(size=6) * SIGMAS)
    return PoseEdge(i, k, step, information(random), certain)


def chained(edges: list[PoseEdge]) -> dict[int, Pose]:
    poses = {0: np.eye(4)}
    for edge in edges:
        poses[edge.second] = poses[edge.first] @ edge.T_first_second
    return poses


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000))
def test_the_solution_is_that_of_dense_least_squares(seed: int) -> None:
    random, true = np.random.default_rng(seed), ring(6)
    steps = [measured(true, i, i + 1, random) for i in range(5)]
    edges = [*steps, measured(true, 0, 5, random), measured(true, 1, 4, random)]
    start = chained(steps)
    roots = [np.linalg.cholesky(edge.information).T for edge in edges]

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = {0: start[0], **{i: moved(start[i], x[6 * i - 6 : 6 * i]) for i in range(1, 6)}}
        return np.concatenate(
            [
                root @ twist(inverse(e.T_first_second) @ inverse(poses[e.first]) @ poses[e.second])
                for root, e in zip(roots, edges, strict=True)
            ]
        )

    best = least_squares(residuals, np.zeros(30), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found = solve_pose_graph(start, edges)
    assert found.cost == pytest.approx(best.cost, rel=1e-6, abs=1e-9)
    np.testing.assert_array_equal(found.trust, 1.0)
    for i in range(1, 6):
        assert max(tangent_norms(moved(start[i], best.x[6 * i - 6 : 6 * i]), found.poses[i])) < 1e-5


def test_a_closed_loop_removes_the_drift_and_wrong_loops_are_not_believed() -> None:
    random, true = np.random.default_rng(3), ring(40)
    exact = information(random) * 100
    steps = [measured(true, i, i + 1, random) for i in range(39)]
    right = [
        PoseEdge(i, k, inverse(true[i]) @ true[k], exact, certain=False)
        for i, k in ((0, 39), (1, 38), (2, 37))
    ]
    wrong = [PoseEdge(i, k, np.eye(4), exact, certain=False) for i, k in ((3, 20), (8, 31))]
    start = chained(steps)
    found = solve_pose_graph(start, [*steps, *right, *wrong])
    np.testing.assert_array_less(0.5, found.trust[39:42])
    np.testing.assert_array_less(found.trust[42:], 1e-3)
    drift = tangent_norms(true[39], start[39])[1]
    assert tangent_norms(true[39], found.poses[39])[1] < 0.1 * drift
    np.testing.assert_array_equal(found.poses[0], start[0])


def test_fixed_nodes_and_those_without_edges_stay() -> None:
    random, true = np.random.default_rng(0), ring(5)
    edges = [measured(true, 1, 2, random), measured(true, 2, 3, random)]
    found = solve_pose_graph(true, edges, fixed=[3]).poses
    for id in (0, 3, 4):
        np.testing.assert_allclose(found[id], true[id], atol=1e-12)
    for edge in edges:  # a chain that ends at a fixed node fits exactly
        off = inverse(edge.T_first_second) @ inverse(found[edge.first]) @ found[edge.second]
        np.testing.assert_allclose(off, np.eye(4), atol=1e-6)


def test_moving_everything_moves_the_solution() -> None:
    random, true = np.random.default_rng(1), ring(8)
    steps = [measured(true, i, i + 1, random) for i in range(7)]
    edges = [*steps, measured(true, 0, 7, random, certain=False)]
    start, T = chained(steps), moved(np.eye(4), [3, -1, 2, 0.5, -0.8, 0.3])
    here = solve_pose_graph(start, edges).poses
    there = solve_pose_graph({id: T @ pose for id, pose in start.items()}, edges).poses
    for id, pose in here.items():
        np.testing.assert_allclose(there[id], T @ pose, atol=1e-6)


def test_an_edge_of_an_unknown_node_is_named() -> None:
    with pytest.raises(ValueError, match="names node 7, which has no pose"):
        solve_pose_graph(ring(2), [PoseEdge(0, 7, np.eye(4), np.eye(6))])


def test_sparse_equations_are_the_dense_ones() -> None:
    random = np.random.default_rng(2)
    moving, other = np.array([1, 2, 3, 3]), np.array([0, 1, 2, 0])
    H = np.stack([information(random) for _ in moving])
    g, to_other = random.normal(size=(4, 6)), random.normal(size=(4, 6, 6))
    equations = PoseEquations(4)
    equations.add_pairs(moving, other, to_other, H, g)
    equations.add(np.array([2]), np.eye(6)[None], np.ones((1, 6)))
    dense, gradient = np.zeros((24, 24)), np.zeros(24)
    for m, o, A, block, slope in zip(moving, other, to_other, H, g, strict=True):
        J = np.zeros((6, 24))
        J[:, 6 * m : 6 * m + 6], J[:, 6 * o : 6 * o + 6] = np.eye(6), A
        dense += J.T @ block @ J
        gradient += J.T @ slope
    dense[12:18, 12:18] += np.eye(6)
    gradient[12:18] += 1
    step = equations.step(np.array([False, True, True, True]))
    np.testing.assert_array_equal(step[0], 0)
    np.testing.assert_allclose(step[1:].ravel(), np.linalg.solve(dense[6:, 6:], -gradient[6:]), rtol=1e-6)


def test_poses_that_nothing_is_known_of_stay() -> None:
    # Keyframes that share nothing, as after a track that was lost at once, have no pair.
    assert not PoseEquations(3).step(np.array([False, True, True])).any()
