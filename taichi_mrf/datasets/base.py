"""What every source of frames looks like to the program, and the options that all of them take."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.errors import DatasetError
from taichi_mrf.frame import Frame


@dataclass(frozen=True)
class ReadOptions:
    """What a caller may say about a recording that its files do not say, or say wrongly."""

    camera: PinholeCamera | None = None
    """Takes the place of the recording's or the format's intrinsics."""

    depth_scale: float | None = None
    """Steps of the depth images per metre; takes the place of the format's own."""

    color: bool = True
    """Read the colour images too, where there are any."""

    max_time_gap: float = 0.02
    """Largest difference in seconds between a depth image and the pose that it is given."""

    def __post_init__(self) -> None:
        scale = self.depth_scale
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise DatasetError(f"depth_scale must be a positive number of steps per metre, not {scale}")
        if not (math.isfinite(self.max_time_gap) and self.max_time_gap >= 0):
            raise DatasetError(f"max_time_gap must be a number of seconds, not {self.max_time_gap}")


@dataclass
class Dataset(ABC):
    """A sequence of frames that are read one at a time.

    ``notes`` are sentences that a report should show: what was assumed or left out. ``dropped`` counts
    the depth images that have no pose near enough in time. A frame that cannot be read does not stop
    the others: :meth:`read` raises FrameError for it and the next one can be read.
    """

    name: str
    camera: PinholeCamera
    notes: list[str] = field(default_factory=list)
    dropped: int = 0

    endless: ClassVar[bool] = False
    """Whether frames come as long as they are asked for, as from a camera: then len says nothing, frames
    cannot be read again, and an error other than FrameError is the end."""

    @property
    @abstractmethod
    def frame_names(self) -> Sequence[str]:
        """What errors and reports call the frames, in their order."""

    @abstractmethod
    def read(self, index: int) -> Frame:
        """The frame with this index, 0 to len - 1. Raises FrameError if it is broken, else IndexError."""

    def __len__(self) -> int:
        return len(self.frame_names)

    def __iter__(self) -> Iterator[Frame]:
        """All frames in order. A broken one raises FrameError, which ends the iteration; to go on after
        it, call :meth:`read` with each index."""
        return (self.read(index) for index in range(len(self)))
