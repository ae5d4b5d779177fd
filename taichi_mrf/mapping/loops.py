"""Closing loops of a tracked camera: a pose graph over the keyframes, which the map follows.

Each new keyframe is aligned with keyframes just before it (steps), and with older ones where the camera may
have come back to: those that are near, as far as the drift since then may be, and look alike (loops). If a
loop disagrees with the poses, the graph is solved and the map's keyframes move. A loop counts only

- if the new image fits the older surface and hardly looks through any of it (alignment/pairs.py);
- if others confirm it, where it would move the map far;
- if the depth of the keyframes that it joins is not much less likely after that, each in the map of all
  others.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.pairs import fit_to, loop
from taichi_mrf.alignment.pose_graph import solve_pose_graph
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.se3 import twist
from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.mapping.tracking import Tracker


@dataclass(frozen=True)
class Closure:
    """A loop that was closed: keyframe ``keyframe`` sees what ``older`` has seen, and was ``off_m`` metres
    and ``off_rad`` radians from where that puts it, more than with other loops that are believed. ``moved``
    are the keyframes that have new poses."""

    keyframe: int
    older: int
    off_m: float
    off_rad: float
    moved: tuple[int, ...]


class LoopCloser:
    """The pose graph of the keyframes of a tracked camera."""

    def __init__(
        self, tracker: Tracker, config: PoseConfig, fixed: Callable[[], Collection[int]] = lambda: ()
    ) -> None:
        """``fixed`` returns the ids of keyframes that must stay where they are."""
        self._map, self._appearances, self._fixed = tracker.map, tracker.appearances, fixed
        self._step_config = replace(config, translation_sigma=RULES.step_m, rotation_sigma=RULES.step_rad)
        self._order: list[int] = []
        self._path_m: dict[int, float] = {}
        self._edges: list[PoseEdge] = []
        self._waiting: list[PoseEdge] = []
        self._anchored: set[int] = set()

    def took(self, id: int) -> Closure | None:
        """Enter a keyframe that was just added into the graph, and close a loop if it does. Raises
        CapacityError if there is not enough memory to move keyframes; the map is usable then."""
        self._forget_gone()
        self._enter(id)
        points = self._points(id)
        for near in self._recent(id):
            self._add_step(id, near, points)
        found = (self._loop(id, older, points) for older in self._candidates(id))
        return self._close([edge for edge in found if edge is not None])

    def _forget_gone(self) -> None:
        """Drop keyframes that were removed or frozen. What was measured against a frozen one stays."""
        keyframes, frozen = self._map.keyframes, self._map.frozen
        for edge in self._edges:
            for gone, other in ((edge.first, edge.second), (edge.second, edge.first)):
                if gone in frozen and other in keyframes:
                    self._anchored.add(other)
        self._order = [id for id in self._order if id in keyframes]
        self._edges = [e for e in self._edges if e.first in keyframes and e.second in keyframes]
        self._waiting = [e for e in self._waiting if e.first in keyframes and e.second in keyframes]

    def _enter(self, id: int) -> None:
        path_m = 0.0
        if self._order:
            last = self._order[-1]
            path_m = self._path_m[last] + tangent_norms(self._pose(last), self._pose(id))[1]
        self._order.append(id)
        self._path_m[id] = path_m

    def _pose(self, id: int) -> Pose:
        return self._map.keyframes[id].T_world_camera

    def _points(self, id: int) -> OrientedPoints:
        image = self._map.keyframes[id].image
        return oriented_points(image, self._map.sensor.max_depth).about(RULES.loop_points)

    def _surface(self, ids: Sequence[int]) -> Surfels:
        surface = self._map.aligner.surface
        surface.update(self._map.keyframes)
        return surface.of(ids)

    def _recent(self, id: int) -> list[int]:
        """The keyframe before, and those of the last ones whose views are nearest."""
        before = self._order[:-1][-RULES.recent :]
        nearest = sorted(before[:-1], key=lambda other: sum(tangent_norms(self._pose(id), self._pose(other))))
        return [*before[-1:], *nearest[: RULES.step_partners - 1]]

    def _add_step(self, id: int, near: int, points: OrientedPoints) -> None:
        """Measure the step from a recent keyframe to a new one. The step from the last one counts as tracked
        where their images tell nothing."""
        T_here, T_near = self._pose(id), self._pose(near)
        tracked = np.diag(np.repeat([RULES.tracked_m, RULES.tracked_rad], 3) ** -2.0)
        follows = self._order[-2] == near and tangent_norms(T_near, T_here)[1] < RULES.farthest_step_m
        fit = fit_to(points, self._surface([near]), [T_here], self._step_config, RULES.loop_cells_m[0])
        if fit is not None and fit.overlap >= self._step_config.min_overlap:
            # Others than the last one have not been tracked from: what the guess says would count twice.
            information = fit.information + tracked if follows else fit.information
            T_near_id = inverse(T_near) @ fit.T_world_camera
            self._edges.append(PoseEdge(near, id, T_near_id, information, certain=follows))
        elif follows:
            self._edges.append(PoseEdge(near, id, inverse(T_near) @ T_here, tracked))

    def _candidates(self, id: int) -> list[int]:
        """Older keyframes that may have seen the same, those that look most alike first. Neighbours of one
        that is chosen tell nothing more."""
        likeness = self._appearances.like(id)
        before = self._order[: -RULES.recent - 1]
        alike = [older for older in before if likeness.get(older, 0.0) > RULES.alike]
        near = [older for older in alike if self._may_see_the_same(id, older)]
        chosen: list[int] = []
        place = {older: n for n, older in enumerate(self._order)}
        for older in sorted(near, key=lambda older: -likeness[older]):
            if all(abs(place[older] - place[other]) > RULES.loop_neighbors for other in chosen):
                chosen.append(older)
        return chosen[: RULES.loops]

    def _may_see_the_same(self, id: int, older: int) -> bool:
        turned, apart_m = tangent_norms(self._pose(older), self._pose(id))
        return apart_m < RULES.view_m + self._drift_m(id, older) and turned < RULES.view_rad

    def _drift_m(self, id: int, older: int) -> float:
        return RULES.drift_m + RULES.drift * (self._path_m[id] - self._path_m[older])

    def _loop(self, id: int, older: int, points: OrientedPoints) -> PoseEdge | None:
        """The step from an older keyframe to a new one, if the new one's image fits there."""
        place = self._order.index(older)
        first, last = max(0, place - RULES.loop_neighbors), place + RULES.loop_neighbors
        surface = self._surface(self._order[first : last + 1])
        T_here, T_there = self._pose(id), self._pose(older)
        turned_there = T_here.copy()
        turned_there[:3, 3] = T_there[:3, 3]
        cells_m = float(np.clip(self._drift_m(id, older), *RULES.loop_cells_m))
        there, here = self._map.keyframes[older], self._map.keyframes[id]
        return loop((older, id), there, surface, here, points, [T_here, T_there, turned_there], cells_m)

    def _off(self, edge: PoseEdge) -> tuple[float, float]:
        """Disagreement of an edge with the poses: metres and radians."""
        T = inverse(self._pose(edge.first)) @ self._pose(edge.second)
        e = twist(inverse(edge.T_first_second) @ T)
        return float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:]))

    def _close(self, loops: Sequence[PoseEdge]) -> Closure | None:
        """Solve the graph with the loops that were found, and move keyframes if they fit better then."""
        self._waiting = [*self._waiting, *loops][-RULES.most_waiting :]
        offs = [self._off(edge) for edge in loops]
        if not any(m > RULES.disagrees_m or rad > RULES.disagrees_rad for m, rad in offs):
            return None
        # The poses that fit steps and loops best, and which of the loops these believe.
        stood = {id: self._pose(id) for id in self._order}
        stays = {min(self._order), *self._anchored, *self._fixed()} & stood.keys()
        solution = solve_pose_graph(stood, [*self._edges, *self._waiting], stays)
        trust = solution.trust[len(self._edges) :]
        believed = [edge for edge, share in zip(self._waiting, trust, strict=True) if share > RULES.trusted]
        if not believed:
            return None
        worst, off = max(((edge, self._off(edge)) for edge in believed), key=lambda each: sum(each[1]))
        # A place may look like another.
        if off[0] > RULES.alone_m and len({edge.second for edge in believed}) < RULES.confirmed:
            return None
        # Is what the keyframes at both ends have measured about as likely now?
        joined = sorted({id for edge in believed for id in self._around_ends(edge)})
        before = self._log_likelihood(joined)
        moved = self._move(solution.poses)
        fits = self._log_likelihood(joined) > before - RULES.loop_loss
        self._waiting = [edge for edge in self._waiting if edge not in believed]
        if not fits:
            self._move(stood)
            return None
        self._edges += believed
        return Closure(worst.second, worst.first, *off, moved)

    def _around_ends(self, edge: PoseEdge) -> list[int]:
        """The keyframes at both ends of a loop and their neighbours."""
        ends = [self._order.index(edge.first), self._order.index(edge.second)]
        return [
            self._order[n] for end in ends for n in range(max(0, end - 1), min(end + 2, len(self._order)))
        ]

    def _log_likelihood(self, ids: Sequence[int]) -> float:
        """Mean log-likelihood of the depth of some keyframes, each in the map of all others."""
        unswept = [id for id, keyframe in self._map.keyframes.items() if keyframe.messages is None]
        self._map.renew(unswept, tolerance=1.0)
        return float(np.nanmean([self._map.depth_log_likelihood(id) for id in ids]))

    def _move(self, poses: Mapping[int, Pose]) -> tuple[int, ...]:
        return self._map.update_poses(poses, least=RULES.least_motion, tolerance=1.0).moved


def loop_closer_of(
    tracker: Tracker | None, config: PoseConfig, fixed: Callable[[], Collection[int]]
) -> LoopCloser | None:
    """Loop closer of a tracked camera, None if the configuration leaves loops open. ``fixed`` as for
    LoopCloser."""
    return LoopCloser(tracker, config, fixed) if tracker is not None and config.close_loops else None
