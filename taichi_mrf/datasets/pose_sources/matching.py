"""Which pose of a source belongs to which frame of a recording."""

import math
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.arguments import real
from taichi_mrf.datasets.conventions import AS_USUAL, Conventions
from taichi_mrf.datasets.mended import origin_of, pose_of
from taichi_mrf.datasets.pose_sources.base import ChangedPoses, PoseSource
from taichi_mrf.datasets.timed_poses import INTERPOLATION_GAP, TimedPoses
from taichi_mrf.errors import KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, as_pose

SAME_STAMP_S = 5e-4
"""A pose whose stamp differs from a frame's by no more than this (seconds) is the frame's own: files round
stamps to milliseconds."""

NAMED_UNKNOWN = 3
"""Frames that a warning names, at most."""

_NUMBER = re.compile(r"\d+")


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
        """How often poses were taken in."""
        self.unknown: list[str] = []
        """Names and numbers of the source that no frame has."""

    def __len__(self) -> int:
        """How many poses the source has."""
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
        """The same poses, without their conventions undone."""
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
        """The pose (4, 4) of the frame with this name that was taken at this time; None if the source has
        none."""
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


def number_in(name: str) -> int | None:
    """The last number in a frame's name, None if there is none."""
    found = _NUMBER.findall(name)
    return int(found[-1]) if found else None
