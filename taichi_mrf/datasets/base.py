"""Interface of a source of frames, and its entry in the registry."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.confidence import Confidence
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.errors import DatasetError, FrameError, KeyframeError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame


def start_pose(up: NDArray[np.float64] | None = None) -> Pose:
    """The first pose of a camera without recorded poses: at the origin, looking along x. It is level, unless
    upwards in the camera frame, a unit vector ``up`` (3,), is known."""
    if up is None:
        return look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    ahead, upper_edge = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
    # What looks straight down or up has the upper or lower edge of its images ahead.
    ahead = ahead if abs(up[2]) < 0.95 else -np.sign(up[2]) * upper_edge
    x = ahead - up * (up @ ahead)
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(up, x), up])
    return T


def when_called(place: str) -> Callable[..., Any]:
    """The function at a place, "module:function", which is imported when it is called."""
    return lambda *arguments: resolve_name(place)(*arguments)


@dataclass(frozen=True)
class Format:
    """A kind of recording in a folder or a file: an entry (entries.py), or a plug (registry.py)."""

    name: str

    looks_for: str
    """The files that make a folder or a file one of this format, as error messages list them."""

    recognises: Callable[[Path], bool]
    """True if a folder or a file is of this format, even if some of its files are missing or damaged."""

    open: Callable[..., "Dataset"]
    """``(path, options)``, a ReadOptions, lists the frames. Raises DatasetError, which names the file."""

    takes_query: bool = False
    """True if ``open`` is ``(path, query, options)``: with the text after a question mark in the name."""


@dataclass(frozen=True)
class BuiltIn:
    """A source that is not a file: its entry in the list (entries.py). ``open`` gets the text after the
    question mark in the source's name, or after a name that ends in a colon."""

    name: str
    open: Callable[[str, ReadOptions], "Dataset"]
    rendered: bool = False
    """True if Taichi renders its frames, so that it must have been started before they are read."""


@dataclass(frozen=True)
class StatedSensor:
    """Facts of the sensor that a recording, or its kind, states; the defaults state nothing."""

    sigma: tuple[float, ...] | None = None
    """Standard deviation of depth: coefficients in ascending powers of depth in metres."""

    pixel_sigma: bool = False
    """True if frames state a sigma for each pixel."""

    origin: str = "the recording's own"
    """Origin of the sigma and the like, in the words of a note."""

    reach_m: float | None = None
    """Reach of the sensor; None if only its depths tell."""

    pass_through: float | None = None
    """Chance that a ray passes an occupied voxel; None for the default's 0."""

    swept_m: float = 0.0
    """Uncorrected motion during an image, in metres, rotations counted at 10 m."""


@dataclass(frozen=True)
class Arrivals:
    """Arrival of a running sensor's frames: ``rate_hz``, and ``age_s``, the present age of the last frame
    read, None before the first. ``news`` are sentences for the user on what has happened since."""

    rate_hz: float
    age_s: float | None
    news: tuple[str, ...] = ()


StampedPoses = tuple[Sequence[float] | NDArray[np.float64], Sequence[Pose]]
"""Stamps in seconds, and the poses (4, 4) T_world_camera at them."""


class EndlessNames(Sequence[str]):
    """Names of frames that are numbered as they arrive, behind a ``prefix``."""

    def __init__(self, prefix: str = "") -> None:
        self.prefix = prefix

    def __len__(self) -> int:
        return 2**31 - 1

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    def __getitem__(self, index: int | slice) -> str | list[str]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return f"{self.prefix}{index:06d}"


@dataclass
class Dataset(ABC):
    """A sequence of frames that are read one at a time.

    ``notes`` are sentences for the report: what was assumed or left out. ``dropped`` counts the depth images
    without a pose near enough in time. ``distortion`` are OpenCV's coefficients of the recorded images, where
    the recording has them; :func:`open_dataset` undistorts the images. If it is ``tracked``, only the first
    frame's pose counts, and mapping finds the others (mapping/tracking.py). For a broken frame :meth:`read`
    raises FrameError; the others can still be read.
    """

    name: str
    camera: Camera
    notes: list[str] = field(default_factory=list)
    dropped: int = 0
    distortion: tuple[float, ...] = ()
    tracked: bool = False
    confidence: Confidence | None = field(default=None, kw_only=True)
    """Meaning of the images of confidence that come with the frames, None without."""

    @property
    def endless(self) -> bool:
        """True if the source never ends, as a camera: then len has no meaning, frames cannot be read twice,
        and an error other than FrameError ends the sequence."""
        return False

    def awaiting(self) -> str:
        """Look for the next frame of a source that never ends, and say what it waits for, in words; empty if
        the frame is there."""
        return ""

    def arrivals(self) -> Arrivals | None:
        """Arrival of a running sensor's frames, None for any other source."""
        return None

    @property
    def stated(self) -> StatedSensor:
        """Facts of the sensor that the recording states: here a sigma that the confidence is relative to."""
        if self.confidence is None:
            return StatedSensor()
        return StatedSensor(self.confidence.sigma, True, self.confidence.origin)

    @property
    def origin_m(self) -> NDArray[np.float64]:
        """Origin of the frames in the recorded world, (3,) metres: add it to their coordinates."""
        return np.zeros(3)

    def check_scale(self, pose: Callable[[int], Pose] | None) -> list[str]:
        """Check the unit of depth, once the camera is final, and return notes; empty for a known unit.
        ``pose`` gives T_world_camera (4, 4) of a frame, and is None where frames have none."""
        return []

    def stamps(self) -> Sequence[float] | NDArray[np.float64]:
        """Time of each frame, in seconds. This reads all frames, unless the source overrides it; a broken
        frame gets the stamp of the one before it."""
        found: list[float] = []
        for index in range(len(self)):
            try:
                found.append(self.read(index).stamp)
            except FrameError:
                found.append(found[-1] if found else 0.0)
        return found

    def pose(self, index: int) -> Pose:
        """T_world_camera, (4, 4), of one frame. This reads the frame, unless the source overrides it. Raises
        what :meth:`read` raises."""
        return self.read(index).T_world_camera

    def own_poses(self) -> "StampedPoses | None":
        """The recorded poses, with stamps of their own; None if there are only those of frames."""
        return None

    def misfit(self) -> str | None:
        """Error in the first image whose file header does not fit; None if all fit, or if headers are not
        checked."""
        return None

    def sensor_of(self, index: int) -> str:
        """The name of the sensor that took a frame (Frame.sensor), empty if there is only one."""
        return ""

    @property
    @abstractmethod
    def frame_names(self) -> Sequence[str]:
        """The names of the frames in order, for errors and reports."""

    @abstractmethod
    def read(self, index: int) -> Frame:
        """The frame with this index, 0 to len - 1. Raises FrameError if it is broken, else IndexError."""

    def __len__(self) -> int:
        return len(self.frame_names)

    def __iter__(self) -> Iterator[Frame]:
        """All frames in order. A broken one raises FrameError, which ends the iteration; to go on after
        it, call :meth:`read` with each index."""
        return (self.read(index) for index in range(len(self)))


@dataclass(frozen=True)
class Row:
    """One frame in a :class:`Table`; a format adds where its images are. ``pose`` is T_world_camera, (4, 4),
    or reads it: that raises DatasetError, which names the file, or KeyframeError for an invalid pose;
    ``pose_source`` then names the file, or the file and the line."""

    name: str
    stamp: float
    pose: Pose | Callable[[], Pose]
    pose_source: str


@dataclass(frozen=True)
class NumberedRow(Row):
    """A frame, and its number in the recording."""

    number: int


AnyRow = TypeVar("AnyRow", bound=Row)


@dataclass
class Table(Dataset, Generic[AnyRow]):
    """A recording as a table with a row for each frame. A format fills it, and says how a row is loaded."""

    rows: Sequence[AnyRow] = field(kw_only=True)
    track: Callable[[], StampedPoses] | None = field(default=None, kw_only=True)
    """Reads the poses with stamps of their own; None if there are only those of rows."""

    def own_poses(self) -> StampedPoses | None:
        return None if self.track is None else self.track()

    @abstractmethod
    def load(self, index: int, row: AnyRow, T_world_camera: Pose) -> Frame:
        """The frame of a row. Raises DatasetError, which names the file."""

    @cached_property
    def frame_names(self) -> Sequence[str]:
        return [row.name for row in self.rows]

    def stamps(self) -> Sequence[float]:
        return [row.stamp for row in self.rows]

    def pose(self, index: int) -> Pose:
        """Raises FrameError, which names the frame and the file; IndexError outside 0 to len - 1."""
        row = self._row(index)
        try:
            return row.pose() if callable(row.pose) else row.pose
        except KeyframeError as error:
            raise FrameError(f"frame {row.name}: {row.pose_source}: {error}") from error
        except DatasetError as error:
            raise FrameError(f"frame {row.name}: {error}") from error

    def read(self, index: int) -> Frame:
        """Read one frame. Raises FrameError, which names the frame and the file, if its images or its pose
        are missing, damaged or do not fit; IndexError outside 0 to len - 1."""
        row, T_world_camera = self._row(index), self.pose(index)
        try:
            return self.load(index, row, T_world_camera)
        except DatasetError as error:
            raise FrameError(f"frame {row.name}: {error}") from error

    def _row(self, index: int) -> AnyRow:
        if not 0 <= index < len(self.rows):
            raise IndexError(f"{self.name} has {len(self.rows)} frames, there is no frame {index}")
        return self.rows[index]
