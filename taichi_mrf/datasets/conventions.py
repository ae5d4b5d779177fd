"""The conventions in which a recording has its poses and depths, where they are not this package's.

A pose is T_world_camera of a camera with optical axes (x right, y down, z ahead), taken when its depth image
was, and depth is along the optical axis. Nothing in a file tells a recording that means something else.
``taichi-mrf doctor`` finds out which convention fits, and these flags undo it.
"""

import math
from dataclasses import dataclass
from difflib import get_close_matches

from taichi_mrf.errors import ConfigError

AXES = ("opengl", "ros")
"""Axes of a camera other than the optical ones: x right, y up, z back; and x ahead, y left, z up."""

INVERSE, W_FIRST, LATE = "inverse", "wxyz", "late"
WORDS = (INVERSE, W_FIRST, *AXES, f"{LATE}=SECONDS")
AXIAL, RANGE = "axial", "range"


@dataclass(frozen=True)
class Conventions:
    """How poses and depths are to be understood. They are undone in the order of the fields."""

    w_first: bool = False
    """Quaternions are w x y z, and were read as x y z w."""

    inverse: bool = False
    """Poses are T_camera_world."""

    axes: str = ""
    """One of AXES, in which the camera's axes are; empty for optical ones."""

    mounting: tuple[float, ...] = ()
    """x y z qx qy qz qw of the camera in the frame that the poses are of, metres; empty if it is the
    camera's own."""

    late_s: float = 0.0
    """The pose of an image is the one that is stamped by so many seconds later."""

    along_ray: bool = False
    """Depth is the distance along the pixel's ray."""

    def __post_init__(self) -> None:
        if self.mounting and not any(self.mounting[3:]):
            raise ConfigError("--mounting takes x,y,z,qx,qy,qz,qw; its quaternion is zero")

    @property
    def of_poses(self) -> bool:
        """True if any of them is of poses."""
        return self != Conventions(along_ray=self.along_ray)

    def flags(self) -> list[str]:
        """The flags that set these conventions, as they are typed."""
        words = [W_FIRST] * self.w_first + [INVERSE] * self.inverse + [self.axes] * bool(self.axes)
        words += [f"{LATE}={self.late_s:g}"] if self.late_s else []
        flags = [f"--poses-are {','.join(words)}"] if words else []
        flags += [f"--mounting {','.join(f'{x:g}' for x in self.mounting)}"] if self.mounting else []
        return flags + [f"--depth-is {RANGE}"] * self.along_ray


AS_USUAL = Conventions()
"""The conventions of this package."""


def conventions_of(poses_are: str | None, mounting: tuple[float, ...] | None, depth_is: str) -> Conventions:
    """The conventions of these flags. Raises ConfigError, which names the flag and the nearest word."""
    words = [word.strip().lower() for word in (poses_are or "").split(",") if word.strip()]
    axes, late_s = "", 0.0
    for word in words:
        name, equals, value = word.partition("=")
        if equals and name == LATE:
            late_s = _seconds(value)
        elif name in AXES and not equals:
            if axes not in ("", name):
                raise ConfigError(f"--poses-are: {axes} and {name} are both axes; name one")
            axes = name
        elif word not in (INVERSE, W_FIRST):
            near = get_close_matches(word, (INVERSE, W_FIRST, *AXES), n=1)
            meant = f"did you mean '{near[0]}'? " if near else ""
            raise ConfigError(f"--poses-are: no such word '{word}'; {meant}It takes {', '.join(WORDS)}")
    return Conventions(W_FIRST in words, INVERSE in words, axes, mounting or (), late_s, depth_is == RANGE)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ConfigError(f"--poses-are: {LATE} takes a number of seconds, not '{text}'")
    return seconds
