"""What every source of frames looks like to the program, and the options that all of them take."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

DISTORTION_COUNTS = (4, 5, 8)
"""How many distortion coefficients a lens may have; OpenCV's other models are not for depth cameras."""


TRACK = "track"
"""In place of a file of poses: find them from the images."""


def start_pose() -> Pose:
    """Where a camera stands whose poses are not known: at the origin, level, looking along x."""
    return look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))


@dataclass(frozen=True)
class ReadOptions:
    """What a caller may say about a recording that its files do not say, or say wrongly."""

    camera: PinholeCamera | None = None
    """Takes the place of the recording's or the format's intrinsics."""

    depth_scale: float | None = None
    """Steps of the depth images per metre; takes the place of the format's own."""

    color: bool = True
    """Read the colour images too, where there are any."""

    max_time_gap: float | None = None
    """Largest difference in seconds between a depth image and the poses that its own comes from; None leaves
    it to the format."""

    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy in pixels: as ``camera``, for images of whatever size the recording has."""

    undistort: tuple[float, ...] | None = None
    """OpenCV's coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]] of the recorded images, which are undistorted
    as they are read. They take the place of the recording's own; zeros leave the images as they are."""

    image_scale: float = 1.0
    """Reads 1/n of the rows and columns: 1, 1/2, 1/3, ..."""

    track: bool = False
    """The recording's poses, if it has any, are of no interest: who maps it finds them from the images."""

    def __post_init__(self) -> None:
        scale = self.depth_scale
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise DatasetError(f"depth_scale must be a positive number of steps per metre, not {scale}")
        gap = self.max_time_gap
        if gap is not None and not (math.isfinite(gap) and gap >= 0):
            raise DatasetError(f"max_time_gap must be a number of seconds, not {gap}")
        if self.camera is not None and self.intrinsics is not None:
            raise DatasetError("camera and intrinsics say the same thing: give one of them")
        if self.intrinsics is not None:
            try:
                PinholeCamera(1, 1, *self.intrinsics)
            except ConfigError as error:
                raise DatasetError(str(error)) from error
        if self.undistort is not None:
            count, finite = len(self.undistort), all(map(math.isfinite, self.undistort))
            if count not in DISTORTION_COUNTS or not finite:
                raise DatasetError(
                    "undistort takes k1,k2,p1,p2, k1,k2,p1,p2,k3 or k1,k2,p1,p2,k3,k4,k5,k6, "
                    f"not {', '.join(f'{k:g}' for k in self.undistort)}"
                )
        scale = self.image_scale
        if not (0 < scale <= 1 and abs(scale * round(1 / scale) - 1) < 0.01):
            raise DatasetError(f"image_scale must be 1, 0.5, 0.333, 0.25 or another 1/n, not {scale:g}")

    @property
    def stride(self) -> int:
        """One in so many rows and columns is read."""
        return round(1 / self.image_scale)


@dataclass
class Dataset(ABC):
    """A sequence of frames that are read one at a time.

    ``notes`` are sentences that a report should show: what was assumed or left out. ``dropped`` counts the
    depth images that have no pose near enough in time. ``distortion`` are OpenCV's coefficients of the images
    as they were recorded, where the recording knows them: :func:`open_dataset` undoes them. If it is
    ``tracked``, the poses of its frames say nothing but where the first was taken: who maps them finds the
    others (mapping/tracking.py). A frame that cannot be read does not stop the others: :meth:`read` raises
    FrameError for it and the next one can be read.
    """

    name: str
    camera: PinholeCamera
    notes: list[str] = field(default_factory=list)
    dropped: int = 0
    distortion: tuple[float, ...] = ()
    tracked: bool = False

    @property
    def endless(self) -> bool:
        """Whether frames come as long as they are asked for, as from a camera: then len says nothing, frames
        cannot be read again, and an error other than FrameError is the end."""
        return False

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
