"""The pose of a bag's camera at a time: from a topic of poses, from the tree of frames, or from a file.

- A topic of poses gives the pose of a **body** in the frame of its header: Odometry names the body, the other
  types do not. The tree's transforms, if there are any, lead from the body to the camera's optical frame.
- The tree alone gives the pose if a transform between its root and the camera moves.
- A file of poses in TUM's layout gives the camera's pose, by the stamps of the bag's images.
- Without any of these, mapping finds the poses from the images.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import start_pose
from taichi_mrf.datasets.options import TRACK
from taichi_mrf.datasets.ros import messages
from taichi_mrf.datasets.ros.runs import BagRun
from taichi_mrf.datasets.ros.sources import NANOSECONDS, Entry, Topic, TopicSource
from taichi_mrf.datasets.ros.stamps import mended_stamps
from taichi_mrf.datasets.ros.tf import WORLDS, TransformTree, alternates
from taichi_mrf.datasets.ros.topics import FROM_TF, choose, topics_of
from taichi_mrf.datasets.timed_poses import TimedPoses, read_timed_poses
from taichi_mrf.errors import DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, as_pose

NO_POSES = (
    "{path}: contains no poses (no Odometry, PoseStamped or tf of a moving {frame}); add ?poses=FILE, with "
    "lines of stamp tx ty tz qx qy qz qw from a tracker or SLAM, or ?poses=track, which finds them from the "
    "images"
)

KEPT_S = 10.0
"""Poses of a robot that runs are kept for so many seconds."""


@dataclass(frozen=True)
class PoseChoice:
    """Choice of poses; an empty text takes the bag's only candidate."""

    pose: str = ""
    """The topic of poses, or tf."""

    poses: str = ""
    """A file of the camera's poses in TUM's layout, in place of any topic; or track, to find them from the
    images."""

    frame: str = ""
    """The fixed frame that the map is made in."""

    body: str = ""
    """The frame that the poses of a topic are of."""

    optical: str = ""
    """The sensor's frame: of a camera x right, y down, z forward; of a lidar z up."""

    tf: str = ""
    """Whose transforms count: those of a namespace, such as /robot1, where robots have trees of their own;
    where publishers disagree those of a node (ROS 1); or ``last`` of fixed transforms that disagree."""

    run: int = 0
    """The run, from 1, where the clock starts again; by default the longest."""


@dataclass
class BagPoses:
    """``at(stamp, largest_gap)`` is T_fixed_camera, (4, 4), or None; ``source`` names the origin of the
    poses and the time that they span, ``stamps`` are theirs, if known. ``registered``: the sensor's data are
    not in its own frame but in the fixed one, where an odometry has put them. ``assumed``: nothing says that
    the poses are of the sensor's own axes. ``hear`` takes a message of a robot that runs, on a topic;
    ``moving`` are the poses that ``at`` interpolates."""

    at: Callable[[float, float], Pose | None]
    source: str
    notes: list[str] = field(default_factory=list)
    registered: bool = False
    stamps: Sequence[float] | NDArray[np.float64] = ()
    assumed: bool = False
    hear: Callable[[Topic, Entry, Any], None] = lambda topic, entry, message: None
    moving: Sequence[TimedPoses] = ()

    @property
    def until(self) -> float:
        """The time in seconds up to which poses are known: later ones have yet to come. A transform that came
        once, beside others that come again, does not move."""
        again = [each for each in self.moving if len(each) > 1] or self.moving
        return min((float(each.stamps.max(initial=-math.inf)) for each in again), default=math.inf)

    def are_apart(self, largest_gap: float) -> bool:
        """True if poses so far are mostly further apart in time than ``largest_gap`` seconds."""
        moving = [each.stamps for each in self.moving if len(each) > 1 and not each.stands_still]
        return any(float(np.median(np.diff(stamps))) > largest_gap for stamps in moving)

    def lacking(
        self, first: NDArray[np.float64], last: NDArray[np.float64], largest_gap: float
    ) -> NDArray[np.bool_]:
        """True for spans of time, from ``first`` to ``last`` (N,) in seconds, that meet a gap between two
        poses longer than ``largest_gap``, or that reach before all poses or after them."""
        moving = [each.stamps for each in self.moving if len(each) > 1 and not each.stands_still]
        found = np.zeros(len(first), bool)
        for stamps in moving or [np.asarray(self.stamps, np.float64)]:
            known = np.concatenate([[-np.inf], stamps, [np.inf]])
            (before,) = np.nonzero(np.diff(known) > largest_gap)
            ends_after = np.searchsorted(known[before + 1], first, side="right")
            found |= known[before][ends_after] < last
        return found


def pose_candidates(reader: TopicSource, tree: TransformTree, optical: str) -> list[str]:
    """The values of the option ``pose``: topics, and ``tf`` if the camera's frame moves in the tree; without
    topics also if transforms that may move do not. Raises DatasetError if there are none because publishers
    disagree."""
    root = tree.ancestors(optical)[-1]
    topics = [name for name in topics_of(reader, *messages.POSES) if not _is_apart(name, tree)]
    if not topics and not tree.moves(root, optical):
        topics = [name for name in topics_of(reader, messages.PATH) if not _is_apart(name, tree)]
    if not topics:
        tree.check(optical)
    by_tf = tree.moves(root, optical) and (not topics or tree.mounted(root, optical) is None)
    return [*topics, *([FROM_TF] if by_tf else [])]


def _is_apart(topic: str, tree: TransformTree) -> bool:
    """True if a topic is another robot's."""
    return any(topic.startswith(f"{space}/") for space in tree.apart)


def find_poses(
    reader: TopicSource,
    frame: str,
    choice: PoseChoice,
    read: Callable[[], TransformTree],
    run: BagRun | None = None,
) -> BagPoses:
    """The poses of the sensor whose messages are in ``frame``, as the user chose, else from the only source
    in the bag; ``read`` gives its tree of frames. Raises DatasetError, which names the file and lists the
    candidates or the frames, if there are none or several, or if the named frames are not connected."""
    if choice.poses == TRACK:
        return BagPoses(lambda stamp, largest_gap: start_pose(), "found from the images")
    if choice.poses:
        timed = read_timed_poses(Path(choice.poses))
        return BagPoses(timed.at, f"{choice.poses}: {_span(timed)}", stamps=timed.stamps)
    tree = read().towards(choice.frame, choice.body)
    optical = choice.optical or frame
    candidates = pose_candidates(reader, tree, optical)
    below = tree.moving_below(optical) if optical and not choice.optical else []
    # What a world of an odometry holds has been moved there, though this world moves in that of a localiser.
    moved = optical in WORLDS and (candidates == [FROM_TF] or choice.pose == FROM_TF)
    if below and (not candidates or moved) and choice.pose in ("", FROM_TF):
        return _of_body(reader, tree, optical, below, choice)
    if not candidates and not choice.pose:
        problem = NO_POSES.format(path=reader.path, frame=optical or "camera frame")
        if tree.misses(optical):
            known = f"frame '{optical}', which tf does not have" if optical else "a frame that has no name"
            problem = (
                f"{reader.path}: the messages are of {known}: set the sensor's with ?optical=FRAME; tf has "
                f"{', '.join(tree.frames)}. Or add ?poses=FILE, or ?poses=track"
            )
        others = [name for name in topics_of(reader, *messages.POSES) if _is_apart(name, tree)]
        if others:
            problem += f". Those of other robots: ?pose={' or ?pose='.join(others)}"
        raise DatasetError(problem)
    if choice.pose == FROM_TF or (not choice.pose and candidates == [FROM_TF]):
        return _from_tree(reader, tree, optical, choice)
    name = choose(reader, "pose", choice.pose, candidates, "topics of poses")
    return _from_topic(reader, name, tree, optical, choice, run or BagRun())


def _from_tree(reader: TopicSource, tree: TransformTree, optical: str, choice: PoseChoice) -> BagPoses:
    if optical not in tree.frames:
        raise _unknown_frame(reader, tree, optical)
    if not choice.frame:
        tree.check(optical)
    fixed = choice.frame or tree.ancestors(optical)[-1]
    must_connect(reader, tree, fixed, optical)
    note = f"poses in {fixed} from tf, of {optical}"
    moving = [edge for edge in tree.between(fixed, optical) if isinstance(edge, TimedPoses)]
    first = max((each.stamps[0] for each in moving), default=0.0)
    last = min((each.stamps[-1] for each in moving), default=math.inf)
    span = f"{first:.3f} to {last:.3f} s"

    return BagPoses(
        lambda stamp, gap: tree.lookup(fixed, optical, stamp, gap),
        f"tf from {fixed} to {optical}: {span}",
        [note],
        stamps=max((each.stamps for each in moving), key=len, default=()),
        hear=_hearing(tree, moving),
        moving=moving,
    )


def _hearing(tree: TransformTree, moving: Sequence[TimedPoses]) -> Callable[[Topic, Entry, Any], None]:
    """Takes the transforms of a robot that runs."""

    def hear(topic: Topic, entry: Entry, message: Any) -> None:
        if topic.type in messages.TF:
            tree.hear(topic.name, entry, message, moving, KEPT_S)

    return hear


def _of_body(
    reader: TopicSource, tree: TransformTree, fixed: str, below: list[str], choice: PoseChoice
) -> BagPoses:
    """The poses of a body of the tree, from whose place the data were moved to the ``fixed`` frame. Raises
    DatasetError if several may be it."""
    body = choice.body or below[0]
    if body not in below or (len(below) > 1 and not choice.body):
        raise DatasetError(
            f"{reader.path}: the messages are in the fixed frame {fixed}, but rays begin at the sensor: set "
            f"its frame with ?body=FRAME, one of {', '.join(below)}"
        )
    if choice.frame not in ("", fixed):
        raise DatasetError(f"{reader.path}: the messages are of {fixed}, so the map is: leave out ?frame=")
    note = f"poses in {fixed} from tf, of {body}, from where the data were moved to {fixed}"
    note += "; ?body=FRAME sets another"
    moving = [edge for edge in tree.between(fixed, body) if isinstance(edge, TimedPoses)]
    return BagPoses(
        lambda stamp, gap: tree.lookup(fixed, body, stamp, gap),
        f"tf from {fixed} to {body}",
        [note],
        True,
        hear=_hearing(tree, moving),
        moving=moving,
    )


def _from_topic(
    reader: TopicSource, name: str, tree: TransformTree, optical: str, choice: PoseChoice, run: BagRun
) -> BagPoses:
    timed, parent, child, notes = _read_poses(reader, name, choice, run)
    tree = tree.towards(choice.body or child, named=False)
    if choice.body:
        must_connect(reader, tree, choice.body, optical)
    body = choice.body or child
    registered = bool(optical) and not choice.optical and tree.is_world_of(optical, parent, body)
    if registered:
        fixed = optical
        of = f", of {body or 'the sensor'}, from where the data were moved to {fixed}"
    else:
        fixed = choice.frame or parent
        with naming(f"{reader.path}: topic {name}"):
            body, of = body_of(tree, optical, body, name, parent)
        if choice.frame:
            must_connect(reader, tree, fixed, parent)
    notes.append(f"poses in {fixed or 'an unnamed frame'} from {name}{of}")

    def at(stamp: float, largest_gap: float) -> Pose | None:
        steps = [tree.lookup(fixed, parent, stamp, largest_gap), timed.at(stamp, largest_gap)]
        steps += [] if registered else [tree.lookup(body, optical, stamp, largest_gap)]
        known = [step for step in steps if step is not None]
        return None if len(known) < len(steps) else reduce(np.matmul, known)

    moving = [timed]
    if not registered:
        steps = [*tree.between(fixed, parent), *tree.between(body, optical)]
        moving += [step for step in steps if isinstance(step, TimedPoses)]

    hear_tf = _hearing(tree, moving)

    def hear(topic: Topic, entry: Entry, message: Any) -> None:
        hear_tf(topic, entry, message)
        of = messages.frame_name(getattr(message, "child_frame_id", ""))
        if topic.name == name and entry.frame in ("", parent) and of in ("", child):
            pose = _valid_pose(message)
            if pose is not None:
                timed.add(entry.stamp, pose, KEPT_S)

    source = f"{name}: {_span(timed)}"
    if registered:
        return BagPoses(at, source, notes, registered=True, hear=hear, moving=moving)
    return BagPoses(
        at,
        source,
        notes,
        stamps=timed.stamps,
        assumed=body == optical and child != optical,
        hear=hear,
        moving=moving,
    )


def _valid_pose(message: Any) -> Pose | None:
    try:
        return as_pose(messages.pose_of(message))
    except KeyframeError:
        return None


def _read_poses(
    reader: TopicSource, name: str, choice: PoseChoice, run: BagRun
) -> tuple[TimedPoses, str, str, list[str]]:
    """A topic's poses, the frame that they are in, the frame that they are of (empty if not given), and
    notes. Raises DatasetError if they are of several bodies."""
    topic = reader.topics[name]
    if topic.type not in (*messages.POSES, messages.PATH):
        raise DatasetError(
            f"{reader.path}: topic {name} is of type {topic.type}; poses are {', '.join(messages.POSES)}"
        )
    sent: dict[tuple[str, str], list[tuple[Entry, Pose]]] = {}
    broken = 0
    unstamped: set[Entry] = set()
    for entry, message in _of_path(reader, name) if topic.type == messages.PATH else reader.messages(name):
        pose = _valid_pose(message)
        if pose is None:
            broken += 1
            continue
        child = messages.frame_name(getattr(message, "child_frame_id", ""))
        if topic.type != messages.PATH and not messages.header_ns(message.header):
            unstamped.add(entry)
        sent.setdefault((entry.frame, child), []).append((entry, pose))
    if not sent:
        raise DatasetError(f"{reader.path}: topic {name}: none of its {broken} messages is a valid pose")
    (parent, child), found = _one_body(f"{reader.path}: topic {name}", sent, choice)
    found = [found[i] for i in run.part([e.stamp for e, _ in found], [e.place for e, _ in found])]
    notes = [f"{broken} messages of {name} left out: not finite, or no rotation"] if broken else []
    stamps = [0.0 if entry in unstamped else entry.stamp for entry, _ in found]
    if any(stamps) and not all(stamps):
        times, wrong = mended_stamps([entry.recorded_ns / NANOSECONDS for entry, _ in found], stamps)
        found = [
            (replace(entry, stamp=time), pose)
            for (entry, pose), time in zip(found, times.tolist(), strict=True)
            if not math.isnan(time)
        ]
        notes.append(
            f"{wrong.sum()} of {len(wrong)} messages of {name} have a stamp that is 0: their times of "
            "recording are used, less the usual delay, or they are left out where that is not known"
        )
    if not found:
        raise DatasetError(f"{reader.path}: topic {name} contains no pose of the run; ?run=N chooses another")
    stamps, poses = [entry.stamp for entry, _ in found], [pose for _, pose in found]
    if alternates(stamps, poses):
        raise DatasetError(
            f"{reader.path}: topic {name}: its poses jump back and forth, as if from two publishers or "
            "robots: ?pose=TOPIC or ?poses=FILE takes others"
        )
    return TimedPoses(stamps, poses), parent, child, notes


def _of_path(reader: TopicSource, name: str) -> Iterator[tuple[Entry, Any]]:
    """The poses of the last message of a Path, which has all of them."""
    for entry, message in deque(reader.messages(name), maxlen=1):
        for i, each in enumerate(message.poses):
            stamp = messages.header_ns(each.header) / NANOSECONDS or entry.stamp
            frame = messages.frame_name(each.header.frame_id) or entry.frame
            yield replace(entry, ordinal=i, stamp=stamp, frame=frame), each


Sent = list[tuple[Entry, Pose]]


def _one_body(
    where: str, sent: dict[tuple[str, str], Sent], choice: PoseChoice
) -> tuple[tuple[str, str], Sent]:
    """The poses of one body in one frame, and the two; messages without these are of the only ones named."""
    parents, children = ({pair[i] for pair in sent if pair[i]} for i in (0, 1))
    for named, wanted, option in ((parents, choice.frame, "frame"), (children, choice.body, "body")):
        if len(named) > 1:
            if wanted not in named:
                choices = " or ".join(f"?{option}={each}" for each in sorted(named))
                what = "in" if option == "frame" else "of"
                raise DatasetError(f"{where}: poses are {what} several frames: choose one with {choices}")
            named &= {wanted}
    (parent,), (child,) = parents or {""}, children or {""}
    several = len({pair[0] for pair in sent if pair[0]}) > 1, len({pair[1] for pair in sent if pair[1]}) > 1
    found = [
        each
        for pair, some in sent.items()
        if (pair[0] == parent or not several[0]) and (pair[1] == child or not several[1])
        for each in some
    ]
    return (parent, child), sorted(found, key=lambda each: (each[0].recorded_ns, each[0].ordinal))


CAMERAS = ("cam", "lidar")
"""Parts of a topic's name that say that its poses are the sensor's own."""


def body_of(
    tree: TransformTree, optical: str, named: str, topic: str = "", parent: str = ""
) -> tuple[str, str]:
    """The frame that a topic's poses in ``parent`` are of, so that it is connected to the sensor's, and a
    note. Raises DatasetError, which does not name the file, if that frame is another body's, or is not known,
    and no transform leads from there to the sensor."""
    if not named:
        body = tree.body(optical, parent)
        if body == optical:
            own = optical or "camera"
            if optical not in tree.frames and not any(word in topic.lower() for word in CAMERAS):
                if not optical and tree.frames:
                    raise DatasetError(
                        "neither the poses nor the data name a frame: set the sensor's and the poses' with "
                        f"?optical=FRAME&body=FRAME; tf has {', '.join(tree.frames)}"
                    )
                options = f"?body={own}" if optical else f"?optical={own}&body={own}"
                raise DatasetError(
                    f"its poses name no child frame, and no transform leads to {optical or 'the sensor'}: "
                    f"{options} uses them as the sensor's own, ?poses=FILE uses others"
                )
            return (
                optical,
                f", assumed to be of the camera ({optical}) itself: the bag has no transform to it",
            )
        return body, f", assumed to be of {body}, to which {optical} is fixed (?body=FRAME sets another)"
    if named != optical and not tree.connects(named, optical):
        tree.check(named)
        tree.check(optical)
        if not optical and tree.frames:
            raise DatasetError(
                f"the poses are of {named}, and the messages name no frame: set the sensor's with "
                f"?optical=FRAME; tf has {', '.join(tree.frames)}"
            )
        if not _is_cameras(named):
            same = f"?body={optical}" if optical else f"?optical={named}"
            listed = tree.frames and optical not in tree.frames
            there = f". If tf names it otherwise, ?optical=FRAME: {', '.join(tree.frames)}" if listed else ""
            raise DatasetError(
                f"the poses are of {named}, and no transform leads to {optical or 'the sensor'}: "
                f"{same} uses them as the sensor's own, ?poses=FILE uses others{there}"
            )
        return optical, (
            f", of {named}, assumed to be of the camera itself: "
            f"no transform from {named} to {optical} is in the bag"
        )
    return named, f", of {named}" + (f", from there to {optical} by tf" if named != optical else "")


def _is_cameras(frame: str) -> bool:
    """True if a frame's name may be that of a camera's optical axes; by REP 105 a link has a body's."""
    name = frame.lower()
    is_body = any(word in name for word in ("link", "base", "pose", "body", "imu"))
    return ("cam" in name or "optical" in name) and not is_body


def must_connect(reader: TopicSource, tree: TransformTree, a: str, b: str) -> None:
    """Raise DatasetError, which lists the frames, unless the tree connects two frames."""
    for frame in (a, b):
        if a != b and frame not in tree.frames:
            raise _unknown_frame(reader, tree, frame)
    if not tree.connects(a, b):
        tree.check(a)
        tree.check(b)
        raise DatasetError(f"{reader.path}: tf does not connect {a} and {b}")


def _unknown_frame(reader: TopicSource, tree: TransformTree, frame: str) -> DatasetError:
    known = ", ".join(tree.frames) or "none"
    return DatasetError(f"{reader.path}: tf has no frame '{frame}'; its frames: {known}")


def _span(timed: TimedPoses) -> str:
    return f"{timed.stamps[0]:.3f} to {timed.stamps[-1]:.3f} s"
