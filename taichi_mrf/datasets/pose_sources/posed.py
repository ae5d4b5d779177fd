"""A recording whose poses come from a source of poses, once or for as long as it is mapped, and which pose of
the source belongs to which frame.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.arguments import real
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.conventions import AS_USUAL, AXIAL, Conventions, conventions_of
from taichi_mrf.datasets.derived import Chosen, Derived, moved_note, origin_of, pose_of, stated_origin
from taichi_mrf.datasets.pose_sources.base import ChangedPoses, PoseSource, WatchedFile, open_pose_source
from taichi_mrf.datasets.recording import Recording, number_in
from taichi_mrf.datasets.registry import open_dataset
from taichi_mrf.datasets.timed_poses import INTERPOLATION_GAP, TimedPoses, check_unit
from taichi_mrf.errors import DatasetError, FrameError, KeyframeError, collected_warnings, naming
from taichi_mrf.geometry.poses import Pose, as_pose, inverse
from taichi_mrf.sensor.frame import Frame

SAME_STAMP_S = 5e-4
"""A pose whose stamp differs from a frame's by no more than this (seconds) is the frame's own: files round
stamps to milliseconds."""

NAMED_UNKNOWN = 3
"""Frames that a warning names, at most."""


class FramePoses:
    """The poses of a source as they were last read, by the frames of a recording."""

    def __init__(
        self,
        source: PoseSource,
        frame_names: Sequence[str],
        largest_gap_s: float | None = None,
        conventions: Conventions = AS_USUAL,
    ) -> None:
        """``frame_names`` are those of the recording in order. Between stamps a pose is interpolated, if its
        neighbours are at most ``largest_gap_s`` seconds away (0.1 by default). The source's poses are in
        these ``conventions``."""
        self.source = source
        self.conventions = conventions
        self.origin_m: NDArray[np.float64] | None = None
        """Origin of the frames in the source's world, (3,) metres: near its first pose if that is far
        away. None before there is one."""
        self._gap_s = INTERPOLATION_GAP if largest_gap_s is None else real(largest_gap_s, "largest_gap_s", 0)
        self._names = set(frame_names)
        self._by_index = dict(enumerate(frame_names))
        self._by_own_number = {n: name for name in frame_names if (n := number_in(name)) is not None}
        self._poses: dict[str, Pose] = {}
        self._timed = TimedPoses([], [])
        self._taken: ChangedPoses = {}
        self.changes = 0
        """Number of times that poses were taken in."""
        self.unknown: list[str] = []
        """Names and numbers of the source that no frame has."""

    def __len__(self) -> int:
        """Number of poses that the source has."""
        return len(self._poses) + len(self._timed)

    @property
    def stamps(self) -> NDArray[np.float64]:
        """The stamps of the poses that have some, seconds."""
        return self._timed.stamps

    @property
    def warning(self) -> str | None:
        """Warning of poses that belong to no frame."""
        if not self.unknown:
            return None
        names = ", ".join(self.unknown[:NAMED_UNKNOWN]) + (
            ", ..." if len(self.unknown) > NAMED_UNKNOWN else ""
        )
        return f"{self.source.name} has poses of {len(self.unknown)} frames that the recording lacks: {names}"

    def renew(self, stamp_s: float = math.inf) -> bool:
        """Ask the source; returns whether it had other poses. Raises DatasetError for a pose that is no rigid
        transform."""
        changed = self.source.poll(stamp_s)
        if changed is not None:
            self.take(changed)
        return changed is not None

    def as_written(self, frame_names: Sequence[str]) -> "FramePoses":
        """These poses, without their conventions undone."""
        written = FramePoses(self.source, frame_names, self._gap_s)
        written.take(self._taken)
        return written

    def take(self, changed: ChangedPoses) -> None:
        """Take in all poses of the source. Raises DatasetError for a pose that is no rigid transform."""
        self._taken = changed
        named: dict[str, Pose] = {}
        numbered: dict[int, Pose] = {}
        stamps: list[float] = []
        timed: list[Pose] = []
        for key, T in changed.items():
            pose = self._checked(key, T)
            if isinstance(key, str):
                named[key] = pose
            elif isinstance(key, int | np.integer):
                numbered[int(key)] = pose
            else:
                stamps.append(float(key) - self.conventions.late_s)
                timed.append(pose)
        name_of = self._name_of(numbered)
        self.unknown = [name for name in named if name not in self._names]
        self.unknown += [str(number) for number in numbered if number not in name_of]
        self._poses = named | {name_of[n]: pose for n, pose in numbered.items() if n in name_of}
        self._timed = TimedPoses(stamps, timed)
        self.changes += 1

    def of(self, name: str, stamp_s: float) -> Pose | None:
        """The pose (4, 4) of the frame of this name and time; None if the source has none."""
        pose = self._poses.get(name)
        if pose is not None or not len(self._timed) or not math.isfinite(stamp_s):
            return pose
        nearest = int(np.argmin(np.abs(self._timed.stamps - stamp_s)))
        if abs(self._timed.stamps[nearest] - stamp_s) <= SAME_STAMP_S:
            return self._timed.poses[nearest].copy()
        return self._timed.at(stamp_s, self._gap_s)

    def _checked(self, key: object, T: object) -> Pose:
        with naming(f"{self.source.name}: the pose of {key}", KeyframeError):
            found = pose_of(as_pose(T), self.conventions)  # type: ignore[arg-type]
        if self.origin_m is None:
            self.origin_m = origin_of(found[:3, 3])
        found[:3, 3] -= self.origin_m
        return found

    def _name_of(self, numbered: dict[int, Pose]) -> dict[int, str]:
        """The frames by number: the number in their names, or their index if that fits more poses."""
        own, index = self._by_own_number, self._by_index
        fits_own, fits_index = len(numbered.keys() & own.keys()), len(numbered.keys() & index.keys())
        return own if fits_own >= fits_index else index


@dataclass
class PosedFrames(Chosen):
    """The frames of ``source`` at the poses of ``poses``. One without a pose there moves with the last frame
    before it that has one. ``follows``: the poses change while the frames are mapped."""

    poses: FramePoses = field(kw_only=True)
    follows: bool = False

    def __post_init__(self) -> None:
        names = self.source.frame_names
        self._index_of = {name: index for index, name in enumerate(names)}
        self._recorded: dict[int, Pose] = {}
        self._carriers: tuple[int, NDArray[np.int64]] = (-1, np.zeros(0, np.int64))

    @property
    def origin_m(self) -> NDArray[np.float64]:
        """That of the poses."""
        return np.zeros(3) if self.poses.origin_m is None else self.poses.origin_m

    def own_poses(self) -> None:
        """None: those of a file are taken in with their conventions undone."""

    def pose(self, index: int) -> Pose:
        """The present pose of one frame. Raises what the source raises."""
        kept = self.indices[index]
        found = self.pose_now(self.frame_names[index], float(self._stamps[kept]))
        return self.source.pose(kept) if found is None else found

    def read(self, index: int) -> Frame:
        """The source's frame at its present pose. Raises what the source raises."""
        if not 0 <= index < len(self.indices):
            raise IndexError(f"{self.name} has {len(self.indices)} frames, there is no frame {index}")
        frame = self.source.read(self.indices[index])
        self._recorded[self.indices[index]] = frame.T_world_camera
        T_world_camera = self.pose_now(frame.name, frame.stamp)
        if T_world_camera is None:
            return frame
        origin_m = None if self.follows else stated_origin(self)  # poses that change may move theirs
        return replace(frame, T_world_camera=T_world_camera, origin_m=origin_m)

    def pose_now(self, name: str, stamp_s: float) -> Pose | None:
        """The present pose (4, 4) of the frame of this name and time; None if it is the recorded one."""
        T_world_camera = self.poses.of(name, stamp_s)
        index = self._index_of.get(name)
        if T_world_camera is not None or index is None:
            return T_world_camera
        carrier = int(self._carrier_of()[index])
        T_recorded, T_carrier = self._recorded_pose(index), self._recorded_pose(carrier)
        if T_recorded is None or T_carrier is None:
            return None
        T_carrier_now = self.poses.of(self.source.frame_names[carrier], float(self._stamps[carrier]))
        assert T_carrier_now is not None, "a carrier has a pose"
        return T_carrier_now @ inverse(T_carrier) @ T_recorded

    @cached_property
    def _stamps(self) -> Sequence[float] | NDArray[np.float64]:
        return self.source.stamps()

    def _carrier_of(self) -> NDArray[np.int64]:
        """For each frame of the source the last one before it that has a pose now, -1 without."""
        version, carriers = self._carriers
        if version != self.poses.changes:
            names, stamps = self.source.frame_names, self._stamps
            posed = [self.poses.of(name, float(s)) is not None for name, s in zip(names, stamps, strict=True)]
            carriers = np.maximum.accumulate(np.where(posed, np.arange(len(posed)), -1))
            self._carriers = self.poses.changes, carriers
        return carriers

    def _recorded_pose(self, index: int) -> Pose | None:
        """The recorded pose of one of the source's frames, None if it is broken or -1."""
        if index not in self._recorded and index >= 0:
            try:
                self._recorded[index] = self.source.pose(index)
            except FrameError:
                return None
        return self._recorded.get(index)


def posed_by(
    dataset: Dataset,
    source: PoseSource,
    *,
    follow: bool = False,
    largest_gap_s: float | None = None,
    has_poses: bool = True,
    conventions: Conventions = AS_USUAL,
) -> PosedFrames:
    """The frames of a dataset at the poses of a source.

    Frames that the source has no pose for move with the last frame before them that has one; they are left
    out if the recording has none (``has_poses``). With ``follow`` mapping asks the source again and again,
    and moves keyframes (mapping/follow.py); it may then begin without any pose. Between two stamps a pose is
    interpolated, if both are at most ``largest_gap_s`` seconds away.
    ``conventions`` are those of the source's poses.

    Raises DatasetError if the source cannot be read or has a pose for no frame, and for frames whose poses
    are found while mapping or are those of several sensors.
    """
    if dataset.tracked or dataset.endless:
        raise DatasetError(
            f"{dataset.name}: its poses are found while it is mapped, and {source.name} cannot replace them; "
            "a RealSense recording takes them as ?poses=FILE, or with ?poses=still"
        )
    names = dataset.frame_names
    if len(names) and dataset.sensor_of(0):
        raise DatasetError(f"{dataset.name}: has several sensors, and {source.name} the poses of one")
    poses = FramePoses(source, names, largest_gap_s, conventions)
    with collected_warnings() as warned:
        if isinstance(source, WatchedFile) and not follow:
            poses.take(source.read_now())
        else:
            poses.renew(float("-inf") if follow else float("inf"))
    kept: Sequence[int] = range(len(names))
    notes = []
    if not follow:
        stamps = dataset.stamps()
        posed = [i for i, name in enumerate(names) if poses.of(name, float(stamps[i])) is not None]
        if 2 * len(posed) < len(names):
            check_unit(stamps, poses.stamps, "frames", dataset.name, source.name)
        if not posed:
            raise DatasetError(
                f"{source.name}: has a pose for none of the {len(names)} frames of {dataset.name}"
            )
        others = len(names) - len(posed)
        notes = [f"poses of {len(posed)} frames from {source.name}"]
        notes += [str(each.message) for each in warned]
        notes += [] if poses.warning is None else [poses.warning]
        notes += [moved_note(poses.origin_m)] if poses.origin_m is not None and poses.origin_m.any() else []
        if others and has_poses:
            moved = "move with the last one before them"
            notes.append(f"{others} of {len(names)} frames have no pose there, and {moved}")
        elif others:
            notes.append(f"{others} of {len(names)} frames dropped: no pose in {source.name}")
            kept = posed
    return PosedFrames(
        dataset.name,
        dataset.camera,
        [*dataset.notes, *notes],
        dataset.dropped + len(names) - len(kept),
        tracked=dataset.tracked,
        source=dataset,
        poses=poses,
        follows=follow,
        indices=kept,
    )


def open_posed(
    source: str | Path,
    poses: str | Path | None,
    *,
    follow: bool = False,
    track: bool = False,
    max_time_gap: float | None = None,
    poses_are: str | None = None,
    mounting: tuple[float, ...] | None = None,
    **reading: Any,
) -> Dataset:
    """Open a recording, with the poses of a file if one is given; without ``follow`` it then need not have
    poses of its own. ``follow`` is that of :func:`posed_by`, the others are keywords of
    :func:`open_dataset`; ``poses_are`` and ``mounting`` are of the file's poses. Raises DatasetError."""
    if poses is None:
        return open_dataset(
            source, track=track, max_time_gap=max_time_gap, poses_are=poses_are, mounting=mounting, **reading
        )
    conventions = conventions_of(poses_are, mounting, AXIAL)
    opened = open_pose_source(poses)
    keywords = {"max_time_gap": max_time_gap, **reading}
    has_poses = True
    try:
        dataset = open_dataset(source, **keywords)
    except DatasetError as problem:
        try:  # it may only lack poses
            dataset = open_dataset(source, track=True, **keywords)
        except DatasetError:
            raise problem from None
        if follow:
            raise DatasetError(f"--follow needs poses from the start: {problem}") from problem
        dataset.tracked = has_poses = False
    posed = posed_by(
        dataset,
        opened,
        follow=follow,
        largest_gap_s=max_time_gap,
        has_poses=has_poses,
        conventions=conventions,
    )
    if not (has_poses or follow):
        _check_scale(posed)
    return posed


def _check_scale(posed: PosedFrames) -> None:
    """Check the unit of depth again, at the poses that the frames of a recording without any now have."""
    source = posed.source
    while isinstance(source, Derived):
        source = source.source
    if not isinstance(source, Recording) or len(source) != len(posed.source):
        return
    place = {kept: index for index, kept in enumerate(posed.indices)}

    def pose(index: int) -> Pose:
        if index not in place:
            raise FrameError(f"{source.frame_names[index]}: has no pose")
        return posed.pose(place[index])

    before = source.scale_notes
    posed.notes = [note for note in posed.notes if note not in before] + source.check_scale(pose)
