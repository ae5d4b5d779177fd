"""Options for reading a source: those of ``open_dataset``, and those after a question mark in its name."""

import math
from dataclasses import dataclass
from typing import TypeVar, get_type_hints

from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.values import check_field, from_dict
from taichi_mrf.datasets.conventions import AXIAL, Conventions, conventions_of
from taichi_mrf.datasets.own_body import NO_BODY, OwnBody
from taichi_mrf.errors import ConfigError, DatasetError, naming
from taichi_mrf.sensor.camera import PinholeCamera

DISTORTION_COUNTS = (4, 5, 8)
"""Possible numbers of distortion coefficients; OpenCV's other models are not for depth cameras."""

TRACK = "track"
"""In place of a file of poses: find them from the images."""

PRIMESENSE = PinholeCamera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
"""The defaults of PrimeSense drivers (Kinect 1, Xtion), which ROS uses too."""

T = TypeVar("T")


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a recording. Each overrides the recording's files or its format."""

    camera: PinholeCamera | None = None
    """Replaces the recording's or the format's intrinsics."""

    depth_scale: float | None = None
    """Steps of the depth images per metre; replaces the format's own."""

    color: bool = True
    """Read the colour images too, where there are any."""

    max_time_gap: float | None = None
    """Largest time in seconds from a depth image to a pose; two around it may be twice this apart. None is
    the format's default."""

    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy in pixels: as ``camera``, with the image size of the recording."""

    undistort: tuple[float, ...] | None = None
    """OpenCV's coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]] of the recorded images, which are undistorted
    as they are read. They replace the recording's own; zeros leave the images as they are."""

    image_scale: float = 1.0
    """Reads 1/n of the rows and columns: 1, 1/2, 1/3, ..."""

    track: bool = False
    """Ignore recorded poses, and find them from the images while mapping."""

    poses_are: str | None = None
    """Conventions of the recorded poses (conventions.py), such as ``inverse,opengl``."""

    mounting: tuple[float, ...] | None = None
    """x y z qx qy qz qw of the camera in the frame that the poses are of."""

    depth_is: str = AXIAL
    """``axial``, or ``range`` for the distance along each pixel's ray."""

    image_is: str | None = None
    """Orientation of stored images (conventions.py), such as ``turned-left``."""

    body: OwnBody = NO_BODY
    """The robot's own body, whose measurements are left out."""

    def __post_init__(self) -> None:
        with naming("", ConfigError):
            self.conventions  # noqa: B018 (it checks its words)
        scale = self.depth_scale
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise DatasetError(f"depth_scale must be a positive number of steps per metre, not {scale}")
        gap = self.max_time_gap
        if gap is not None and not (math.isfinite(gap) and gap >= 0):
            raise DatasetError(f"max_time_gap must be a number of seconds, not {gap}")
        if self.camera is not None and self.intrinsics is not None:
            raise DatasetError("camera and intrinsics both set the intrinsics; pass only one of them")
        if self.intrinsics is not None:
            with naming("", ConfigError):
                PinholeCamera(1, 1, *self.intrinsics)
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
    def conventions(self) -> Conventions:
        """The conventions of poses and depths. Raises ConfigError."""
        return conventions_of(self.poses_are, self.mounting, self.depth_is, self.image_is)

    @property
    def stride(self) -> int:
        """Every ``stride``-th row and column is read."""
        return round(1 / self.image_scale)


def require(options: object, **bounds: float | tuple[float, float]) -> None:
    """Raise ConfigError for the first of these fields that is less than its least value, or more than its
    largest if there are two."""
    for name, bound in bounds.items():
        least, most = bound if isinstance(bound, tuple) else (bound, math.inf)
        given = getattr(options, name)
        check_field(given >= least, name, f"must be at least {least}, not {given}")
        check_field(given <= most, name, f"must be at most {most}, not {given}")


def parse_options(cls: type[T], query: str, source: str) -> T:
    """Parse ``name=value&name=value`` into a dataclass, whose fields are the options. A field of type str
    takes its text unchanged, such as a path. Raises DatasetError, which names the source, for an option that
    does not exist (naming the nearest), a value of the wrong type or out of range, and for text that is not
    of the form name=value."""
    texts = {field for field, hint in get_type_hints(cls).items() if hint is str}
    values = {}
    for option in query.split("&") if query else ():
        name, equals, text = option.partition("=")
        try:
            values[name] = text if name in texts else parse_yaml(text)
        except ValueError:
            equals = ""
        if not (name and equals):
            raise DatasetError(f"{source}?{query}: options are written name=value, with & between them")
    with naming("", ConfigError):
        return from_dict(cls, values, source)
