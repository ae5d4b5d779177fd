"""Closing loops of a camera without poses: a pose graph over the keyframes, which the map follows.

Each new keyframe is aligned with the keyframes just before it that have seen the same (steps), and with
older ones where the camera may have come back to, because they are near, as far as the drift since then
may be, and look alike (loops). If a loop disagrees with the poses, the graph is solved and the map's
keyframes move. A loop stays only if it makes the depth of the keyframes that it joins more likely, each in
the map of all others.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.appearance import Appearances, small_picture
from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.pairs import PairFit, fit_to
from taichi_mrf.alignment.pose_graph import Edge, solve_pose_graph
from taichi_mrf.alignment.se3 import twist
from taichi_mrf.alignment.seen_through import looked_through
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.mapping.tracking import Tracker
from taichi_mrf.methods.capabilities import AligningMap
from taichi_mrf.sensor.frame import Frame

POINTS = 5000
"""Points of a keyframe that are aligned, about."""

RECENT = 10
"""So many keyframes before a new one are no loop."""

STEPS = 3
"""Recent keyframes that a new one is aligned with."""

STEP_M, STEP_RAD = 0.05, 0.03
"""Standard deviations of the tracked step between two keyframes, which counts where depth determines nothing."""

DRIFT_M, DRIFT = 0.05, 0.03
"""How far a tracked camera may be off, in metres and as a share of its way since then."""

VIEW_M, VIEW_RAD = 1.0, 1.0
"""How far two cameras that see the same may stand apart and be turned against each other."""

LOOPS = 3
"""Older keyframes that a new one is aligned with."""

ALIKE = 0.5
"""Least likeness (alignment/appearance.py) of an older keyframe."""

AROUND = 2
"""Keyframes before and after an older one whose surface counts with its own."""

CELLS_M = (0.12, 0.5)
"""Width of the first level's cells of a loop, between these; the drift in between."""

OVERLAP, AGREEMENT = 0.5, 0.6
"""Shares of the points near the older surface, and of those on it, that a loop needs."""

TRUSTED = 0.25
"""Least trust of a loop in the solved graph."""

ALONE_M, CONFIRMED = 0.2, 2
"""Loops that move the map by more than this need to be found from so many keyframes."""

MOST_WAITING = 12
"""Loops that wait to be confirmed, at most."""

TRACE = False
THROUGH = 0.05
"""Share of the older surface that the image may look through."""

DISAGREES_M, DISAGREES_RAD = 0.01, 0.005
"""The graph is solved if a loop is off by more than this."""

LEAST_MOTION = 0.02
"""Voxels that what a keyframe sees must move by at least, or it stays."""

FREE = PoseConfig(translation_sigma=1e3, rotation_sigma=1e3)
"""The guesses of a loop count for nothing."""


@dataclass(frozen=True)
class Closure:
    """A loop that was closed: keyframe ``keyframe`` saw what ``older`` had seen, ``off_m`` and ``off_rad`` from
    where the poses had it. ``moved`` are the keyframes whose poses have changed."""

    keyframe: int
    older: int
    off_m: float
    off_rad: float
    moved: tuple[int, ...]


class LoopCloser:
    """The pose graph of one map's keyframes."""

    def __init__(self, m: AligningMap, config: PoseConfig) -> None:
        self._map = m
        self._step_config = replace(config, translation_sigma=STEP_M, rotation_sigma=STEP_RAD)
        self._order: list[int] = []
        self._way_m: dict[int, float] = {}
        self._edges: list[Edge] = []
        self._waiting: list[Edge] = []
        self._appearances = Appearances()

    def took(self, id: int, frame: Frame) -> Closure | None:
        """Enter a keyframe that was just added, with the frame that it was made of, into the graph; close a
        loop if it does. Raises CapacityError if the map's keyframes cannot be moved for lack of memory."""
        keyframes = self._map.keyframes
        self._order = [known for known in self._order if known in keyframes]
        self._edges = [e for e in self._edges if e.first in keyframes and e.second in keyframes]
        self._waiting = [e for e in self._waiting if e.first in keyframes and e.second in keyframes]
        picture = small_picture(frame)
        likeness = self._appearances.likeness(picture)
        self._enter(id)
        points = self._points(id)
        # Steps to the keyframes just before.
        for near in self._recent(id):
            self._measure_step(id, near, points)
        # Loops to older ones.
        loops = []
        for older in self._candidates(id, likeness):
            edge = self._loop(id, older, points)
            if edge is not None:
                loops.append(edge)
        self._appearances.add(id, picture)
        return self._close(loops)

    def _enter(self, id: int) -> None:
        way_m = 0.0
        if self._order:
            last = self._order[-1]
            way_m = self._way_m[last] + tangent_norms(self._pose(last), self._pose(id))[1]
        self._order.append(id)
        self._way_m[id] = way_m

    def _pose(self, id: int) -> Pose:
        return self._map.keyframes[id].T_world_camera

    def _points(self, id: int) -> OrientedPoints:
        points = oriented_points(self._map.keyframes[id].image, self._map.sensor.max_depth)
        return points.thinned(max(1, round(math.sqrt(len(points.points) / POINTS))))

    def _recent(self, id: int) -> list[int]:
        """The keyframe before, and those before that which are nearest."""
        before = self._order[:-1][-RECENT:]
        if not before:
            return []
        nearest = sorted(before[:-1], key=lambda other: self._apart(id, other))
        return [before[-1], *nearest[: STEPS - 1]]

    def _apart(self, a: int, b: int) -> float:
        """How far two cameras are apart, with an angle of one radian as far as a metre."""
        return sum(tangent_norms(self._pose(a), self._pose(b)))

    def _measure_step(self, id: int, near: int, points: OrientedPoints) -> None:
        fit = fit_to(points, self._surface([near]), [self._pose(id)], self._step_config, CELLS_M[0])
        follows = self._order.index(id) == self._order.index(near) + 1
        if fit is None or fit.overlap < self._step_config.min_overlap:
            if not follows:
                return
            information = np.diag(np.repeat([STEP_M, STEP_RAD], 3) ** -2.0)
            fit = PairFit(self._pose(id), information, 0.0, 0.0, 0, 0.0)
        T_near_id = inverse(self._pose(near)) @ fit.T_world_camera
        self._edges.append(Edge(near, id, T_near_id, fit.information, certain=follows))

    def _surface(self, ids: Sequence[int]):
        surface = self._map.aligner.surface
        surface.update(self._map.keyframes)
        return surface.of(ids)

    def _candidates(self, id: int, likeness: dict[int, float]) -> list[int]:
        """Older keyframes that may have seen the same, those that look most alike first."""
        found = []
        for older in self._order[: -RECENT - 1]:
            turned, apart_m = tangent_norms(self._pose(older), self._pose(id))
            if (
                apart_m < VIEW_M + self._drift_m(id, older)
                and turned < VIEW_RAD
                and likeness.get(older, 0.0) > ALIKE
            ):
                found.append(older)
        found.sort(key=lambda older: -likeness[older])
        chosen: list[int] = []
        for older in found:  # neighbours of one that is tried already tell nothing new
            if all(abs(self._order.index(older) - self._order.index(c)) > AROUND for c in chosen):
                chosen.append(older)
        return chosen[:LOOPS]

    def _drift_m(self, id: int, older: int) -> float:
        return DRIFT_M + DRIFT * (self._way_m[id] - self._way_m[older])

    def _loop(self, id: int, older: int, points: OrientedPoints) -> Edge | None:
        """The step from an older keyframe to a new one, if the new one's depth fits there."""
        place = self._order.index(older)
        surface = self._surface(self._order[max(0, place - AROUND) : place + AROUND + 1])
        T_here, T_there = self._pose(id), self._pose(older)
        as_there = T_here.copy()
        as_there[:3, 3] = T_there[:3, 3]
        cells_m = float(np.clip(self._drift_m(id, older), *CELLS_M))
        fit = fit_to(points, surface, [T_here, T_there, as_there], FREE, cells_m)
        if fit is None or fit.directions < 6 or fit.overlap < OVERLAP or fit.agreement < AGREEMENT:
            return None
        through = looked_through(surface.planes(), self._map.keyframes[id].image, fit.T_world_camera)
        if TRACE: print('   loop', id, older, f'ov {fit.overlap:.2f} ag {fit.agreement:.2f} through {through:.3f} off', np.round(self._off(Edge(older, id, inverse(T_there) @ fit.T_world_camera, fit.information)),3))
        if through > THROUGH:
            return None
        return Edge(older, id, inverse(T_there) @ fit.T_world_camera, fit.information, certain=False)

    def _off(self, edge: Edge) -> tuple[float, float]:
        """By how much an edge disagrees with the poses: metres and radians."""
        T = inverse(self._pose(edge.first)) @ self._pose(edge.second)
        e = twist(inverse(edge.T_first_second) @ T)
        return float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:]))

    def _close(self, loops: Sequence[Edge]) -> Closure | None:
        """Solve the graph and move the map's keyframes, if loops disagree with the poses."""
        self._waiting = [*self._waiting, *loops][-MOST_WAITING:]
        offs = [self._off(edge) for edge in loops]
        if not any(m > DISAGREES_M or rad > DISAGREES_RAD for m, rad in offs):
            return None
        stood = {id: self._pose(id) for id in self._order}
        solution = solve_pose_graph(stood, [*self._edges, *self._waiting])
        trusted = solution.trust[len(self._edges) :] > TRUSTED
        believed = [edge for edge, yes in zip(self._waiting, trusted, strict=True) if yes]
        worst = int(np.argmax([m + rad for m, rad in offs]))
        # A place may look like another: what moves the map far has to be found from several keyframes.
        found_from = {edge.second for edge in believed}
        if not believed or (max(offs)[0] > ALONE_M and len(found_from) < CONFIRMED):
            return None
        joined = sorted({id for edge in believed for id in self._joined(edge)})
        before = self._likelihood(joined)
        moved = self._move(solution.poses)
        after = self._likelihood(joined)
        if TRACE: print('   judged', before, after, len(believed), len(self._waiting))
        if not after > before:
            self._move(stood)
            self._waiting = [edge for edge in self._waiting if edge not in believed]
            return None
        self._edges += believed
        self._waiting = [edge for edge in self._waiting if edge not in believed]
        return Closure(loops[worst].second, loops[worst].first, *offs[worst], moved)

    def _joined(self, edge: Edge) -> list[int]:
        """The keyframes around both ends of a loop."""
        ends = [self._order.index(edge.first), self._order.index(edge.second)]
        return [self._order[p] for end in ends for p in range(max(0, end - 1), min(end + 2, len(self._order)))]

    def _likelihood(self, ids: Sequence[int]) -> float:
        """Mean log-likelihood of the depth of some keyframes, each in the map of all others."""
        unswept = [id for id, keyframe in self._map.keyframes.items() if keyframe.messages is None]
        self._map.renew(unswept, tolerance=1.0)
        return float(np.nanmean([self._map.depth_log_likelihood(id) for id in ids]))

    def _move(self, poses: dict[int, Pose]) -> tuple[int, ...]:
        return self._map.update_poses(poses, least=LEAST_MOTION, tolerance=1.0).moved


def loop_closer_of(tracker: Tracker | None, config: PoseConfig) -> LoopCloser | None:
    """What closes the loops of a tracked camera, None if the configuration leaves them open."""
    return None if tracker is None or not config.close_loops else LoopCloser(tracker.map, config)
