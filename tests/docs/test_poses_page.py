"""The examples of docs/poses.md that solve a pose graph, on a loop whose solution is a closed form."""

from pathlib import Path

import numpy as np
import pytest
from pages import code_of

from taichi_mrf.datasets.pose_sources.graph_file import read_pose_graph
from taichi_mrf.geometry.poses import Pose

MEASURED = [1.04, 0.97, 1.02, -0.95, -1.06, -0.93]
"""Metres along x from each node to the next; the last leads back to the first, and the sum should be 0."""

SIGMAS = np.array([0.02, 0.01, 0.03, 0.01, 0.02, 0.015])


def at(x_m: float) -> Pose:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def edge(first: int, second: int, x_m: float, sigma: float) -> str:
    upper = np.diag([sigma**-2] * 3 + [1e4] * 3)[np.triu_indices(6)]
    return f"EDGE_SE3:QUAT {first} {second} {x_m} 0 0 0 0 0 1 {' '.join(map(str, upper))}"


def examples(repository: Path) -> list[str]:
    page = (repository / "docs" / "poses.md").read_text(encoding="utf-8")
    return [found for found in code_of(page) if "solve_pose_graph" in found]


def test_a_graph_in_a_file_is_solved_and_a_wrong_loop_named(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    drifted = np.concatenate([[0.0], np.cumsum(MEASURED[:-1])])
    vertices = [f"VERTEX_SE3:QUAT {i} {x} 0 0 0 0 0 1" for i, x in enumerate(drifted)]
    ends = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0)]
    steps = [edge(*pair, x, sigma) for pair, x, sigma in zip(ends, MEASURED, SIGMAS, strict=True)]
    Path("slam.g2o").write_text("\n".join([*vertices, *steps]))
    solve, doubt = examples(repository)
    names: dict[str, object] = {}
    exec(solve, names)  # what the page tells people to run
    # What is missing to a closed loop is shared out by the variances of the steps.
    shares = SIGMAS**2 / np.sum(SIGMAS**2)
    closed = np.concatenate([[0.0], np.cumsum(np.array(MEASURED) - sum(MEASURED) * shares)])
    found = read_pose_graph(Path("closed.g2o"))
    for i, x_m in enumerate(closed[:-1]):
        np.testing.assert_allclose(found.poses[i], at(x_m), atol=1e-6)
    assert len(found.edges) == len(ends)
    exec(doubt, names)
    assert capsys.readouterr().out == "[]\n"
    wrong = edge(1, 4, 2.5, 0.01)
    Path("slam.g2o").write_text("\n".join([*vertices, *steps, wrong]))
    exec(solve, names)
    exec(doubt, names)
    assert capsys.readouterr().out == "[(1, 4)]\n"
