"""The conventions in which a recording has its poses and depths, where they are not this package's.

A pose is T_world_camera of a camera with optical axes (x right, y down, z ahead), taken when its depth image
was, and depth is along the optical axis. Nothing in a file tells a recording that means something else.
``taichi-mrf doctor`` finds out which convention fits, and these flags undo it.
"""

import math
from dataclasses import dataclass
from difflib import get_close_matches

from taichi_mrf.errors import ConfigError

AXES = ("opengl", "ros", "ned")
"""Axes of a camera other than the optical ones: x right, y up, z back; x ahead, y left, z up; and x ahead, y
right, z down, as of aircraft, whose world is north-east-down."""

POSE_UNITS = {"mm": 1000.0, "cm": 100.0}
"""Units of positions other than metres, and how many are in a metre."""

INVERSE, W_FIRST, LATE = "inverse", "wxyz", "late"
SAME = {"arkit": "opengl", "blender": "opengl"}
"""Other names of words."""

_PLAIN = (INVERSE, W_FIRST, *AXES, *POSE_UNITS)
WORDS = (*_PLAIN, f"{LATE}=SECONDS")
AXIAL, RANGE = "axial", "range"

TURNS = {
    "turned-left": (1, False),
    "turned-right": (3, False),
    "upside-down": (2, False),
    "mirrored": (0, True),
    "turned-left,mirrored": (1, True),
    "turned-right,mirrored": (3, True),
    "upside-down,mirrored": (2, True),
}
"""Ways to store images: quarter turns to the left, and True if they were mirrored before that."""


@dataclass(frozen=True)
class Conventions:
    """Conventions of poses and depths. They are undone in the order of the fields."""

    w_first: bool = False
    """Quaternions are w x y z, and were read as x y z w."""

    unit: str = ""
    """One of POSE_UNITS, in which positions are; empty for metres."""

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

    turned: str = ""
    """One of TURNS, by which images are turned; empty if they are as the sensor took them."""

    def __post_init__(self) -> None:
        if self.mounting and not any(self.mounting[3:]):
            raise ConfigError("--mounting takes x,y,z,qx,qy,qz,qw; its quaternion is zero")

    @property
    def of_poses(self) -> bool:
        """True if any of them is of poses."""
        return self != Conventions(along_ray=self.along_ray, turned=self.turned)

    def flags(self) -> list[str]:
        """The flags that set these conventions, as they are typed."""
        words = [W_FIRST] * self.w_first + [INVERSE] * self.inverse
        words += [word for word in (self.axes, self.unit) if word]
        words += [f"{LATE}={self.late_s:g}"] if self.late_s else []
        flags = [f"--poses-are {','.join(words)}"] if words else []
        flags += [f"--mounting {','.join(f'{x:g}' for x in self.mounting)}"] if self.mounting else []
        flags += [f"--depth-is {RANGE}"] * self.along_ray
        return flags + [f"--image-is {self.turned}"] * bool(self.turned)


AS_USUAL = Conventions()
"""The conventions of this package."""


def conventions_of(
    poses_are: str | None, mounting: tuple[float, ...] | None, depth_is: str, image_is: str | None = None
) -> Conventions:
    """The conventions of these flags. Raises ConfigError, which names the flag and the nearest word."""
    words = [SAME.get(word, word) for word in _words(poses_are)]
    late_s = 0.0
    for word in words:
        name, equals, value = word.partition("=")
        if equals and name == LATE:
            late_s = _seconds(value)
        elif word not in _PLAIN:
            raise ConfigError(_no_word("--poses-are", word, (*_PLAIN, *SAME), WORDS))
    axes, unit = _only(words, AXES, "axes"), _only(words, tuple(POSE_UNITS), "units")
    along_ray, turned = depth_is == RANGE, _turn(image_is)
    return Conventions(
        W_FIRST in words, unit, INVERSE in words, axes, mounting or (), late_s, along_ray, turned
    )


def _words(text: str | None) -> list[str]:
    return [word.strip().lower() for word in (text or "").split(",") if word.strip()]


def _no_word(flag: str, word: str, known: tuple[str, ...], words: tuple[str, ...]) -> str:
    near = get_close_matches(word, known, n=1)
    meant = f"did you mean '{near[0]}'? " if near else ""
    return f"{flag}: no such word '{word}'; {meant}It takes {', '.join(words)}"


def _turn(image_is: str | None) -> str:
    """The one of TURNS that is said, empty for none. Raises ConfigError."""
    single = tuple(turn for turn in TURNS if "," not in turn)
    words = set(_words(image_is))
    for word in words.difference(single):
        raise ConfigError(_no_word("--image-is", word, single, single))
    if not words:
        return ""
    for turn in TURNS:
        if words == set(turn.split(",")):
            return turn
    raise ConfigError(f"--image-is: {' and '.join(sorted(words - {'mirrored'}))} are both turns; name one")


def _only(words: list[str], choice: tuple[str, ...], what: str) -> str:
    """The word that is one of a choice, empty if none is. Raises ConfigError if two are."""
    found = list(dict.fromkeys(word for word in words if word in choice))
    if len(found) > 1:
        raise ConfigError(f"--poses-are: {found[0]} and {found[1]} are both {what}; name one")
    return found[0] if found else ""


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ConfigError(f"--poses-are: {LATE} takes a number of seconds, not '{text}'")
    return seconds
