"""A pose graph: the poses that agree best with measured steps between them, some of which may be wrong.

    minimise over all T    sum over edges (i, k) of  rho(e' Omega e) / 2,    e = log(inv(Z_i_k) inv(T_i) T_k)

with Z_i_k the measured pose of k in the frame of i and Omega its information. rho is the square for edges
that are certain. Edges that close a loop may join two places that only look alike: for those rho is that of
Geman and McClure, which no longer grows for an edge far from all others. Such a sum has many minima, so
the search begins with a rho that is nearly the square and narrows it step by step (graduated non-convexity,
Yang et al., RA-L 2020). Each step is one sparse linear system (Gauss-Newton with Levenberg's damping).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.pose_equations import PoseEquations
from taichi_mrf.alignment.se3 import Twists, adjoint, exps, inverse_right_jacobians, logs
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, inverses

REJECTED = 16.8
"""e' Omega e at which an uncertain edge counts a quarter: one in a hundred right ones is larger (chi squared
with six degrees of freedom)."""

NARROWING = 1.4
"""Factor by which rho is narrowed from one step to the next."""

MOST_STEPS = 300
"""Steps at most."""

SETTLED = 0.01
"""rho is narrowed once a step changes the cost by less than this share of it."""

LARGEST_DAMPING = 1e6
"""No step lowers the cost if even one that is damped so much does not."""

SMALLEST_STEP = 1e-5
"""Metres or radians: a smaller step is the last."""


@dataclass(frozen=True)
class Solution:
    """The poses (4, 4) of all nodes, and how far each edge was trusted, from 0 to 1 in the edges' order.
    ``cost`` is that of the edges so weighted."""

    poses: dict[int, Pose]
    trust: NDArray[np.float64]
    cost: float


def solve_pose_graph(
    poses: Mapping[int, Pose], edges: Sequence[PoseEdge], fixed: Collection[int] = ()
) -> Solution:
    """The poses at which the edges fit best. The search begins at ``poses``; nodes that are ``fixed`` stay,
    and so does the one with the lowest id if none is. Raises ValueError for an edge of an unknown node."""
    problem = _Problem(poses, edges, set(fixed) or {min(poses)})
    return problem.solve()


class _Problem:
    def __init__(self, poses: Mapping[int, Pose], edges: Sequence[PoseEdge], fixed: set[int]) -> None:
        self.ids = list(poses)
        number = {id: n for n, id in enumerate(self.ids)}
        unknown = {id for edge in edges for id in (edge.first, edge.second)} - number.keys()
        if unknown:
            raise ValueError(f"an edge of the pose graph names node {min(unknown)}, which has no pose")
        self.T = np.stack([poses[id] for id in self.ids])
        self.first = np.array([number[edge.first] for edge in edges], np.intp)
        self.second = np.array([number[edge.second] for edge in edges], np.intp)
        self.Z = np.stack([edge.T_first_second for edge in edges]) if edges else np.zeros((0, 4, 4))
        self.information = np.zeros((len(edges), 6, 6))
        for n, edge in enumerate(edges):
            self.information[n] = np.eye(6) if edge.information is None else edge.information
        self.certain = np.array([edge.certain for edge in edges], bool)
        self.free = np.array([id not in fixed for id in self.ids], bool)

    def solve(self) -> Solution:
        """Graduated non-convexity around Levenberg's steps."""
        error = self._errors(self.T)
        # rho is nearly the square as long as `width` is above all e' Omega e.
        width = max(1.0, 2.0 * float(self._squares(error)[~self.certain].max(initial=0.0)) / REJECTED)
        trust = self._trust(error, width)
        damping = 1e-6
        for _ in range(MOST_STEPS):
            if not self.free.any() or len(self.first) == 0:
                break
            step = self._step(error, trust, damping)
            tried_T = self.T @ exps(step)
            tried = self._errors(tried_T)
            before, after = self._cost(error, trust), self._cost(tried, trust)
            if after <= before:
                self.T, error, damping = tried_T, tried, max(1e-9, damping / 10)
            else:
                damping *= 10
            if width == 1.0 and (np.abs(step).max() < SMALLEST_STEP or damping > LARGEST_DAMPING):
                break
            if abs(before - after) < SETTLED * before or damping > LARGEST_DAMPING:
                width, damping = max(1.0, width / NARROWING), min(damping, 1e-3)
            trust = self._trust(error, width)
        return Solution(dict(zip(self.ids, self.T, strict=True)), trust, self._cost(error, trust))

    def _errors(self, T: NDArray[np.float64]) -> Twists:
        """e of each edge."""
        return logs(inverses(self.Z) @ inverses(T[self.first]) @ T[self.second])

    def _squares(self, error: Twists) -> NDArray[np.float64]:
        """e' Omega e of each edge."""
        return np.asarray(np.einsum("ni,nij,nj->n", error, self.information, error))

    def _cost(self, error: Twists, trust: NDArray[np.float64]) -> float:
        return 0.5 * float(trust @ self._squares(error))

    def _trust(self, error: Twists, width: float) -> NDArray[np.float64]:
        """The weight of each edge under Geman and McClure's rho, ``width`` times as wide as it will be."""
        narrow = REJECTED * width
        weights = (narrow / (narrow + self._squares(error))) ** 2
        return np.where(self.certain, 1.0, weights)

    def _step(self, error: Twists, trust: NDArray[np.float64], damping: float) -> Twists:
        """The damped step of every pose, (n, 6), 0 for those that are fixed."""
        # With T exp(xi), e changes by inv(J_r(e)) (xi_second - Ad(inv(T_second) T_first) xi_first).
        to_first = -adjoint(inverses(self.T[self.second]) @ self.T[self.first])
        J = inverse_right_jacobians(error)
        weighted = trust[:, None, None] * np.swapaxes(J, -1, -2) @ self.information
        H, g = weighted @ J, np.einsum("nij,nj->ni", weighted, error)
        equations = PoseEquations(len(self.ids))
        equations.add_pairs(self.second, self.first, to_first, H, g)
        return equations.step(self.free, damping)
