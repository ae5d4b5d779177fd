"""A tree of coordinate frames, as ROS keeps it: a fixed or moving transform connects each frame to its
parent."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, inverse

Edge = Pose | TimedPoses
"""T_parent_child, (4, 4), or such poses with stamps."""


WORLDS = ("map", "odom", "world", "earth", "utm")
"""Frames that are fixed by their names (REP 105), and no body."""


@dataclass(frozen=True)
class Dispute:
    """A frame about which publishers disagree: what to say of it, and T_parent_frame by each parent."""

    problem: str
    edges: Mapping[str, Edge]


class TransformTree:
    """Frames and the transforms between them. ``edges`` maps a frame to its parent and T_parent_frame; frames
    that are ``disputed`` are roots until one of their parents is chosen. ``apart`` are the namespaces of
    other robots."""

    def __init__(
        self,
        edges: Mapping[str, tuple[str, Edge]],
        disputed: Mapping[str, Dispute] | None = None,
        apart: Sequence[str] = (),
    ) -> None:
        self.edges = dict(edges)
        self.disputed = dict(disputed or {})
        self.apart = tuple(apart)
        self._held: dict[str, Pose | None] = {}

    def towards(self, *frames: str, named: bool = True) -> "TransformTree":
        """The tree in which a disputed frame has the parent that leads to one of some frames, if only one
        does, or that is one of them, if the user ``named`` them."""
        tree = self
        for child, dispute in self.disputed.items():
            leading = [p for p in dispute.edges if named and p in frames] or [
                p for p in dispute.edges if any(f and f in self.ancestors(p) for f in frames)
            ]
            if len(leading) == 1:
                edges = {**tree.edges, child: (leading[0], dispute.edges[leading[0]])}
                disputed = {f: each for f, each in tree.disputed.items() if f != child}
                tree = TransformTree(edges, disputed, self.apart)
        return tree

    def check(self, frame: str) -> None:
        """Raise DatasetError if the way from a frame to its root ends at a dispute."""
        dispute = self.disputed.get(self.ancestors(frame)[-1])
        if dispute is not None:
            raise DatasetError(dispute.problem)

    @property
    def frames(self) -> list[str]:
        """All frames by name."""
        return sorted({*self.edges, *(parent for parent, _ in self.edges.values())})

    def ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, its parent's parent, ... up to the root. Raises DatasetError for a cycle."""
        path = [frame]
        while path[-1] in self.edges:
            parent = self.edges[path[-1]][0]
            if parent in path:
                raise DatasetError(f"tf: the frames {', '.join(path)} form a circle")
            path.append(parent)
        return path

    def connects(self, a: str, b: str) -> bool:
        """True if two frames are connected."""
        return a == b or self.ancestors(a)[-1] == self.ancestors(b)[-1]

    def is_world_of(self, frame: str, parent: str, body: str) -> bool:
        """True if a frame is fixed where poses of a ``body`` in ``parent`` are: the parent, one above it, or
        one that is fixed to it and not to the body."""
        if frame == parent or frame in self.ancestors(parent):
            return True
        return self.mounted(parent, frame) is not None and self.mounted(body, frame) is None

    def moving_below(self, frame: str) -> list[str]:
        """The lowest frames that move in a frame; of those fixed to each other the one that moves."""
        below = [each for each in self.edges if frame in self.ancestors(each)[1:] and self.moves(frame, each)]
        bodies = dict.fromkeys(self.body(each, frame) for each in below)
        return [each for each in bodies if not any(each in self.ancestors(o)[1:] for o in bodies)]

    def moves(self, a: str, b: str) -> bool:
        """True if a transform on the way from one connected frame to the other changes with time."""
        return any(isinstance(edge, TimedPoses) for edge in self.between(a, b))

    def between(self, a: str, b: str) -> list[Edge]:
        """The transforms on the way from one connected frame to the other."""
        up, down = self._sides(a, b)
        return [self.edges[frame][1] for frame in (*up, *down)]

    def body(self, frame: str, world: str = "") -> str:
        """The highest frame that the frame is fixed to, also by a transform that is sent again and again:
        that of the vehicle that carries a camera. It is below ``world``, in which it moves."""
        path = self.ancestors(frame)
        tops = [i for i, each in enumerate(path) if each == world or each in WORLDS]
        path = path[: max(1, min(tops))] if tops else path
        moving = [each for each in path if each in self.edges and self._holds(each) is None]
        return moving[0] if moving else path[-1]

    def mounted(self, a: str, b: str) -> Pose | None:
        """T_a_b, (4, 4), if transforms connect the frames that are the same at all times."""
        if not {a, b} <= set(self.frames) or not self.connects(a, b):
            return None
        if any(self._holds(frame) is None for side in self._sides(a, b) for frame in side):
            return None
        return self.lookup(a, b, 0.0, 0.0)

    def lookup(self, target: str, source: str, stamp: float, largest_gap: float) -> Pose | None:
        """T_target_source, (4, 4), at a time in seconds; None where a moving transform on the way has no pose
        near enough in time on both sides (:meth:`TimedPoses.at`). The frames must be connected."""
        up, down = self._sides(target, source)
        T_top_target = self._chain(up, stamp, largest_gap)
        T_top_source = self._chain(down, stamp, largest_gap)
        if T_top_target is None or T_top_source is None:
            return None
        return inverse(T_top_target) @ T_top_source

    def _sides(self, a: str, b: str) -> tuple[list[str], list[str]]:
        """The frames from each of two up to, but without, their first common ancestor."""
        of_a, of_b = self.ancestors(a), self.ancestors(b)
        common = next(frame for frame in of_a if frame in of_b)
        return of_a[: of_a.index(common)], of_b[: of_b.index(common)]

    def _holds(self, frame: str) -> Pose | None:
        """T_parent_frame if it is the same at all times: fixed, or sent again and again without a change, or
        once where it is another frame that moves."""
        if frame not in self._held:
            edge = self.edges[frame][1]
            if isinstance(edge, TimedPoses):
                still = edge.stands_still or (len(edge) == 1 and self._moves_beside(frame))
                self._held[frame] = edge.poses[0] if still else None
            else:
                self._held[frame] = edge
        return self._held[frame]

    def _moves_beside(self, frame: str) -> bool:
        """True if a frame above or below this one moves in its parent."""
        moving = [
            other
            for other, (_, edge) in self.edges.items()
            if isinstance(edge, TimedPoses) and len(edge) > 1 and not edge.stands_still
        ]
        return any(frame in self.ancestors(other) or other in self.ancestors(frame) for other in moving)

    def _chain(self, frames: list[str], stamp: float, largest_gap: float) -> Pose | None:
        T = np.eye(4)
        for frame in frames:
            step, edge = self._holds(frame), self.edges[frame][1]
            if step is None and isinstance(edge, TimedPoses):
                step = edge.at(stamp, largest_gap)
            if step is None:
                return None
            T = step @ T
        return T
