"""The flags that set how a recording is read: one group for every command that reads one.

Whether the values make sense is checked where they are used (base.ReadOptions). Heavy libraries are not
imported here, so that the command line's help stays fast.
"""

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

from taichi_mrf.datasets.conventions import conventions_of
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class SourceFlags(OwnBody):
    """Options for reading SOURCE; :meth:`keywords` are arguments of ``open_dataset``."""

    depth_scale: float | None = None
    """Steps of the depth images per metre, such as 1000 for millimetres, instead of the format's own."""

    camera: str | None = None
    """Intrinsics fx,fy,cx,cy in pixels, instead of the recording's."""

    undistort: str | None = None
    """Undo the lens distortion k1,k2,p1,p2[,k3] (OpenCV's coefficients); zeros leave the images unchanged."""

    image_scale: float = 1.0
    """Read 1/n of the rows and columns: 1, 0.5, 0.333, 0.25, ... Pixels are dropped, not averaged."""

    max_time_gap: float | None = None
    """Largest time in seconds from a depth image to a pose; two poses around it may be twice this apart."""

    poses_are: str | None = None
    """Conventions of the recorded poses, as 'taichi-mrf doctor' finds them, separated by commas: inverse
    (T_camera_world), wxyz (w first), opengl, ros or ned (axes of the camera), mm or cm (unit),
    late=SECONDS."""

    mounting: str | None = None
    """Pose of the camera in the body frame of the recorded poses: x,y,z,qx,qy,qz,qw in metres."""

    depth_is: Literal["axial", "range"] = "axial"
    """Depth along the optical axis, or distance along each pixel's ray."""

    image_is: str | None = None
    """Orientation of the images relative to the sensor's poses, as found by 'taichi-mrf doctor': turned-left,
    turned-right or upside-down, and mirrored (left and right exchanged), separated by a comma."""

    def words(self) -> list[str]:
        """The flags that differ from the defaults, as they are typed."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        changed = {name: value for name, value in given.items() if value != getattr(SourceFlags, name)}
        boxes = changed.pop("body_box", ())
        words = [f"--{name.replace('_', '-')}={value}" for name, value in changed.items()]
        return words + [word for box in boxes for word in ("--body-box", *map(str, box))]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.keywords()

    def keywords(self) -> dict[str, Any]:
        """Keyword arguments of ``open_dataset``. Raises ConfigError, which names the flag."""
        keywords: dict[str, Any] = {
            "depth_scale": self.depth_scale,
            "intrinsics": _numbers("--camera", self.camera, (4,), "fx,fy,cx,cy"),
            "undistort": _numbers("--undistort", self.undistort, (4, 5, 8), "k1,k2,p1,p2[,k3]"),
            "image_scale": self.image_scale,
            "max_time_gap": self.max_time_gap,
            "poses_are": self.poses_are,
            "mounting": _numbers("--mounting", self.mounting, (7,), "x,y,z,qx,qy,qz,qw"),
            "depth_is": self.depth_is,
            "image_is": self.image_is,
            "body": self.own_body,
        }
        conventions_of(self.poses_are, keywords["mounting"], self.depth_is, self.image_is)
        return keywords


def _numbers(flag: str, text: str | None, counts: tuple[int, ...], wanted: str) -> tuple[float, ...] | None:
    """The numbers of a comma-separated text, None for None."""
    if text is None:
        return None
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in counts or not all(map(math.isfinite, values)):
        raise ConfigError(f"{flag} takes {wanted}, not {text!r}")
    return values
