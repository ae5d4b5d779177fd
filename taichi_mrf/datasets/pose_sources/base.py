"""Interface of a source of poses, and the entry of its kind in the registry.

A source gives the poses of some frames as they are known now. It is asked again and again, and answers only
if something has changed since: a file that was written again, a database that was optimised, a topic of a bag
whose next message is due.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from numpy.typing import ArrayLike

FrameKey = str | int | float
"""Which frame a pose is of: a frame's name (str), its number (int), or the time when it was taken, in seconds
(float). A number is the one in the frames' names, or the frame's index from 0, whichever fits more poses."""

ChangedPoses = Mapping[FrameKey, ArrayLike]
"""Poses T_world_camera, (4, 4), by frame."""


class PoseSource(Protocol):
    """Poses that may change while a map is made."""

    @property
    def name(self) -> str:
        """Name of the source in messages: a path, or what a caller named it."""
        ...

    @property
    def problem(self) -> str | None:
        """Why the source cannot be read at present, if that has lasted for some time; None if it can be."""
        ...

    def poll(self, stamp_s: float) -> ChangedPoses | None:
        """All poses that are known now, None if they are those of the last call.

        ``stamp_s`` is the recording's time in seconds, infinite once the recording is over: a source that has
        times of its own gives what was known then. Does not wait.
        """
        ...


@dataclass(frozen=True)
class PoseKind:
    """A kind of source in a file: its entry in the registry (registry.py)."""

    name: str

    looks_for: str
    """Marks of a file of this kind, as error messages list it."""

    recognises: Callable[[Path], bool]
    """True if a file is of this kind, even if it is damaged."""

    open: Callable[[Path, str], PoseSource]
    """Open a file with the text after the question mark in its name. Raises DatasetError."""


@dataclass(frozen=True)
class CallbackPoses:
    """Poses that a function gives: ``function(stamp_s)`` returns all poses that are known, or None if they
    have not changed. What it raises ends a run of ``map_sequence``."""

    function: Callable[[float], ChangedPoses | None]
    name: str = "the callback"
    problem: str | None = None

    def poll(self, stamp_s: float) -> ChangedPoses | None:
        """Poses that the function returns."""
        return self.function(stamp_s)
