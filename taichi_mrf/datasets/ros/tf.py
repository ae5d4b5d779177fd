"""The tree of frames of a sensor, out of a bag's tf topics.

Each robot has its own: the tree of a sensor is that of its topic's namespace, /robot1/tf for
/robot1/camera/depth, with what other tf topics add to it without a clash. Publishers that disagree about a
frame, or about its parent, leave it disputed; what passes through it asks the user.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.messages import frame_name
from taichi_mrf.datasets.ros.reader import RosReader
from taichi_mrf.datasets.ros.runs import BagRun
from taichi_mrf.datasets.ros.transform_tree import Dispute, Edge, TransformTree
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.errors import DatasetError, KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose

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
    sent: dict[str, Transforms],
    topic: str,
    frame: str,
    tf: str = "",
    run: BagRun | None = None,
) -> TransformTree:
    """The tree of frames of the sensor whose messages are on ``topic`` and in ``frame``. Transforms on a
    topic called tf_static are fixed; the last message counts. ``tf`` is the option of that name. Raises
    DatasetError, which does not name the file, if several trees may be the sensor's, or if ``tf`` names
    nothing."""
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
                f"tf: the transform of {child} in {rows[0].parent} is none: not finite, or a quaternion of 0"
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


def read_transforms(reader: RosReader) -> dict[str, Transforms]:
    """Transforms that were sent in each namespace."""
    sent: dict[str, Transforms] = {}
    for topic in reader.topics.values():
        if topic.type not in messages.TF:
            continue
        is_static = topic.name.endswith("tf_static")
        transforms = sent.setdefault(topic.name.rpartition("/")[0], defaultdict(list))
        for entry, message in reader.messages(topic.name):
            for each in message.transforms:
                parent, child = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
                try:
                    pose = as_pose(messages.pose_of(each))
                except KeyframeError:
                    pose = np.full((4, 4), np.nan)  # an uninitialised transform, which leaves a gap
                stamp = messages.header_ns(each.header) / 1e9 or entry.stamp
                if parent and child:
                    transforms[child].append(
                        _Sent(parent, pose, stamp, entry.place, entry.publisher, is_static)
                    )
    return sent


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
        edge, disagree = TimedPoses([r.stamp for r in moving], [r.pose for r in moving]), False
        disagree = alternates([r.stamp for r in moving], [r.pose for r in moving])
        if not disagree:
            return edge
    nodes = sorted({each.publisher for each in rows} - {""})
    if len(nodes) > 1:
        remedy = f"choose one with {' or '.join(f'?tf={node}' for node in nodes)}; {remedy}"
    return Dispute(
        f"tf: transforms of {child} in {parent} contradict each other{_senders(rows)}, as of two robots or "
        f"publishers: {remedy}",
        {},
    )


def _senders(rows: Iterable[_Sent]) -> str:
    nodes = sorted({each.publisher for each in rows} - {""})
    return f" (from {', '.join(nodes)})" if nodes else ""


def _steps(poses: np.ndarray, apart: int = 1) -> np.ndarray:
    """How far each pose (N, 4, 4) is from a later one, in units of what counts as the same."""
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
