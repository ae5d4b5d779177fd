"""The tree of frames of a sensor, out of a bag's tf topics: a fixed or moving transform connects each frame
to its parent.

Each robot has its own: the tree of a sensor is that of its topic's namespace, /robot1/tf for
/robot1/camera/depth, with what other tf topics add to it without a clash. Publishers that disagree about a
frame, or about its parent, leave it disputed; what passes through it asks the user.
"""

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.runs import BagRun
from taichi_mrf.datasets.ros.sources import NANOSECONDS, Entry, TopicSource
from taichi_mrf.datasets.ros.stamps import mended_stamps
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.errors import DatasetError, KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose, inverse

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

    def hear(
        self, topic: str, entry: Entry, message: Any, moving: Collection[TimedPoses], keep_s: float
    ) -> None:
        """Add the transforms of a message that has just come to those of this tree's that are ``moving``, of
        which the last ``keep_s`` seconds are kept."""
        if namespace(topic) in self.apart:
            return
        for child, row in _sent_in(topic, entry, message):
            parent, edge = self.edges.get(child, ("", None))
            found = next((each for each in moving if each is edge), None)
            if found is not None and parent == row.parent and np.isfinite(row.pose).all():
                found.add(row.stamp or entry.stamp, row.pose, keep_s)
                self._held.clear()

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

    def misses(self, frame: str) -> bool:
        """True if the tree moves and has no such frame: the sensor's has another name there."""
        return frame not in self.frames and any(isinstance(e, TimedPoses) for _, e in self.edges.values())

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
            edge = self.edges[frame][1]
            step = edge.at(stamp, largest_gap) if isinstance(edge, TimedPoses) else edge
            step = self._holds(frame) if step is None else step
            if step is None:
                return None
            T = step @ T
        return T


_SAME_M, _SAME_RAD = 0.05, 0.05
"""Publishers agree if their transforms differ by less."""

_FASTEST = 40.0
"""In units of the two a second: what jumps to and fro faster is not one body."""

_LONGEST_BURST, _LEAST_SHARE = 3, 0.06
"""Messages that one publisher sends between two of another, and the share of such among all."""

LAST = "last"
"""The value of the option ``tf`` that takes the last of fixed transforms that disagree."""


@dataclass(frozen=True)
class _Sent:
    parent: str
    pose: Pose
    stamp: float
    place: int
    publisher: str
    is_static: bool


Transforms = dict[str, list[_Sent]]
"""Transforms that were sent of each frame, in the order of recording."""


def tree_of(
    sent: dict[str, Transforms], topic: str, frame: str, tf: str = "", run: BagRun | None = None
) -> TransformTree:
    """The tree of frames of the sensor whose messages are on ``topic`` and in ``frame``. Transforms on a
    topic called tf_static are fixed; the last message counts. ``tf`` is the option of that name. Raises
    DatasetError, which does not name the file, if several trees may be its own, or ``tf`` names none."""
    publishers = sorted(
        {each.publisher for all_ in sent.values() for some in all_.values() for each in some} - {""}
    )
    named = tf.rstrip("/") if tf and tf.rstrip("/") in sent else None
    if tf and named is None and tf not in (*publishers, LAST):
        known = ", ".join([*(f"{space}/" for space in sent), *publishers])
        raise DatasetError(f"?tf={tf} names no namespace or publisher of tf: {known or 'none'}")
    edges: dict[str, tuple[str, Edge]] = {}
    disputed: dict[str, Dispute] = {}
    transforms, apart = _of_sensor(sent, topic, frame, named)
    for child, rows in transforms.items():
        valid = [each for each in rows if np.isfinite(each.pose).all()]
        if not valid:
            problem = (
                f"tf: the transform of {child} in {rows[0].parent} is not finite, or its quaternion is zero"
            )
            disputed[child] = Dispute(f"{problem}; ?poses=FILE takes poses of the sensor itself", {})
            continue
        rows = valid
        preferred = [each for each in rows if tf and each.publisher == tf] or rows
        found = _edge(child, preferred, tf == LAST, run or BagRun())
        if isinstance(found, Dispute):
            disputed[child] = found
        elif found is not None:
            edges[child] = found
    return TransformTree(edges, disputed, apart)


def read_transforms(reader: TopicSource) -> dict[str, Transforms]:
    """Transforms that were sent in each namespace."""
    sent: dict[str, dict[str, list[tuple[_Sent, float]]]] = {}
    for topic in reader.topics.values():
        if topic.type not in messages.TF:
            continue
        transforms = sent.setdefault(namespace(topic.name), defaultdict(list))
        for entry, message in reader.messages(topic.name):
            for child, row in _sent_in(topic.name, entry, message):
                transforms[child].append((row, entry.stamp))
    return {
        space: {child: _stamped(rows) for child, rows in transforms.items()}
        for space, transforms in sent.items()
    }


def namespace(topic: str) -> str:
    """The namespace of a topic of transforms: /robot1 of /robot1/tf."""
    return topic.rpartition("/")[0]


def _sent_in(topic: str, entry: Entry, message: Any) -> Iterator[tuple[str, _Sent]]:
    """The transforms in a message, by the frames that they are of."""
    is_static = topic.endswith("tf_static")
    for each in message.transforms:
        parent, child = messages.frame_name(each.header.frame_id), messages.frame_name(each.child_frame_id)
        try:
            pose = as_pose(messages.pose_of(each))
        except KeyframeError:
            pose = np.full((4, 4), np.nan)  # an uninitialised transform, which leaves a gap
        stamp = messages.header_ns(each.header) / NANOSECONDS
        if parent and child:
            yield child, _Sent(parent, pose, stamp, entry.place, entry.publisher, is_static)


def _stamped(rows: Sequence[tuple[_Sent, float]]) -> list[_Sent]:
    """Transforms with the times of recording of their messages. Where some stamps are 0, moving ones come by
    that time, less the usual delay; where that is not known they are left out."""
    if all(row.stamp for row, _ in rows):
        return [row for row, _ in rows]
    static = [replace(row, stamp=row.stamp or recorded) for row, recorded in rows if row.is_static]
    moving = [(row, recorded) for row, recorded in rows if not row.is_static]
    stamps, _ = mended_stamps([recorded for _, recorded in moving], [row.stamp for row, _ in moving])
    found = zip(moving, stamps.tolist(), strict=True)
    return static + [replace(row, stamp=stamp) for (row, _), stamp in found if not math.isnan(stamp)]


def _of_sensor(
    sent: dict[str, Transforms], topic: str, frame: str, named: str | None
) -> tuple[Transforms, list[str]]:
    """The transforms of the sensor's namespace with those of others that give none of the same frames, and
    the namespaces of other robots."""
    around = sorted((space for space in sent if topic.startswith(f"{space}/")), key=len, reverse=True)
    own = named if named is not None else next(iter(around), "")
    apart = [space for space in sent if space != own]
    found = dict(sent.get(own, {}))
    children = [child for space in apart for child in sent[space]]
    for space in sorted(apart, key=len, reverse=True):
        is_near = f"{own}/".startswith(f"{space}/") or (not own and not _are_twins(space, topic))
        if is_near and not any(c in found or (not own and children.count(c) > 1) for c in sent[space]):
            found |= sent[space]
            apart.remove(space)
    root = frame
    for _ in found:
        root = found[root][0].parent if root in found else root
    holding = [space for space in apart if root in sent[space]]
    if not own and named is None and len(holding) > 1:
        choices = " or ".join(f"?tf={space}" for space in holding)
        raise DatasetError(f"several trees of frames contain {root}, of {topic}: choose one with {choices}")
    return found, [space for space in apart if space]


def _are_twins(space: str, topic: str) -> bool:
    """True if two names begin with those of two robots: /robot1 and /robot2."""
    a, b = (name.split("/")[1] for name in (f"{space}/", topic if "/" in topic else "/"))
    return a != b and re.sub(r"\d+", "", a) == re.sub(r"\d+", "", b) != ""


def _edge(child: str, rows: Sequence[_Sent], last: bool, run: BagRun) -> tuple[str, Edge] | Dispute | None:
    """The parent and transform of a frame, or what is disputed; None if nothing was sent in the run."""
    by_parent: dict[str, list[_Sent]] = defaultdict(list)
    moving = [each for each in rows if not each.is_static]
    part = run.part([each.stamp for each in moving], [each.place for each in moving])
    moving = [moving[i] for i in part]
    for each in [*moving, *_static(rows, run)]:
        by_parent[each.parent].append(each)
    found = {parent: _one_parent(parent, child, some, last) for parent, some in by_parent.items()}
    if len(found) < 2:
        return next(((p, edge) if not isinstance(edge, Dispute) else edge for p, edge in found.items()), None)
    parents = ", ".join(f"{p}{_senders(some)}" for p, some in by_parent.items())
    choices = " or ".join(f"?frame={parent}" for parent in found)
    nodes = sorted({each.publisher for some in by_parent.values() for each in some} - {""})
    choices += "".join(f" or ?tf={node}" for node in nodes)
    edges = {parent: edge for parent, edge in found.items() if not isinstance(edge, Dispute)}
    return Dispute(f"tf: the frame {child} has several parents, {parents}: choose one with {choices}", edges)


def _static(rows: Sequence[_Sent], run: BagRun) -> list[_Sent]:
    """The fixed transforms that were sent up to the end of the run, or all if they came later."""
    static = [each for each in rows if each.is_static]
    return [each for each in static if not run.is_over(each.place)] or static


def _one_parent(parent: str, child: str, rows: Sequence[_Sent], last: bool) -> Edge | Dispute:
    """The transform between two frames, or what is disputed."""
    static = [each.pose for each in rows if each.is_static]
    moving = [each for each in rows if not each.is_static]
    remedy = "?pose=TOPIC or ?poses=FILE takes poses from elsewhere"
    if static:
        T = static[-1]
        off = max(float(_steps(np.stack([T, each.pose]))[0]) for each in rows)
        if off <= 1 or (last and not moving):
            return T
        remedy = f"?tf={LAST} takes the last, " + remedy if not moving else remedy
    else:
        stamps, poses = [each.stamp for each in moving], [each.pose for each in moving]
        if not alternates(stamps, poses):
            return TimedPoses(stamps, poses)
    nodes = sorted({each.publisher for each in rows} - {""})
    if len(nodes) > 1:
        remedy = f"choose one with {' or '.join(f'?tf={node}' for node in nodes)}; {remedy}"
    return Dispute(
        f"tf: transforms of {child} in {parent} contradict each other{_senders(rows)}, as if from two "
        f"robots or publishers: {remedy}",
        {},
    )


def _senders(rows: Iterable[_Sent]) -> str:
    nodes = sorted({each.publisher for each in rows} - {""})
    return f" (from {', '.join(nodes)})" if nodes else ""


def _steps(poses: np.ndarray, apart: int = 1) -> np.ndarray:
    """Distance of each pose (N, 4, 4) from a later one, in units of what counts as the same."""
    first, last = poses[:-apart], poses[apart:]
    metres = np.linalg.norm(last[:, :3, 3] - first[:, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", first[:, :3, :3], last[:, :3, :3]) - 1) / 2
    return np.maximum(metres / _SAME_M, np.arccos(np.clip(cosine, -1, 1)) / _SAME_RAD)


def alternates(stamps: Sequence[float], poses: Sequence[Pose]) -> bool:
    """True if poses with stamps are those of two bodies in turn: again and again a few of them are far from
    those before and after, which are near each other."""
    order = np.argsort(stamps, kind="stable")
    s, T = np.asarray(stamps, np.float64)[order], np.asarray(poses, np.float64).reshape(-1, 4, 4)[order]
    odd = np.zeros(len(s), bool)
    if len(s) < 3:
        return False
    step = _steps(T)
    jumps = (step > 1) & (step > _FASTEST * np.diff(s))
    for burst in range(1, min(_LONGEST_BURST, len(s) - 2) + 1):
        out, back = step[:-burst], step[burst:]
        returns = np.minimum(out, back) > 4 * _steps(T, burst + 1)
        odd[1 : len(s) - burst] |= jumps[:-burst] & jumps[burst:] & returns
    return int(odd.sum()) >= max(2, _LEAST_SHARE * len(s))
