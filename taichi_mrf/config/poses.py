"""Which frames become keyframes, and how far depth may move them: two parts of config.py."""

import math
from dataclasses import dataclass
from typing import Literal

from taichi_mrf.config.values import check_field


@dataclass(frozen=True)
class KeyframeConfig:
    """Which frames become keyframes (section V): those that have moved enough."""

    rotation: float = 0.0
    """A frame that is rotated by more than this (radians, tangent norm) becomes a keyframe; 0 means that
    rotation does not count."""

    translation: float = 0.0
    """A frame that is translated by more than this (metres) becomes a keyframe; 0 means that translation
    does not count. With both at 0 every frame is a keyframe."""

    against: Literal["last", "all"] = "last"
    """Compare with the last keyframe, as in the paper, or with all earlier ones, so that a place that is
    visited again adds nothing."""

    def __post_init__(self) -> None:
        check_field(self.rotation >= 0, "keyframes.rotation", "must not be negative")
        check_field(self.translation >= 0, "keyframes.translation", "must not be negative")


@dataclass(frozen=True)
class PoseConfig:
    """Poses that are slightly wrong, and how far depth may move them (method mrf)."""

    refine: bool = False
    """Align each new keyframe with those before it, and at the end all keyframes with each other. The first
    keyframe stays where it is."""

    rounds: int = 2
    """How often, at the end, every keyframe is aligned with all others."""

    translation_sigma: float = 0.03
    """How wrong recorded poses are along each axis (metres, standard deviation). What depth does not tell
    stays as it was recorded; what it tells badly is a compromise between the two."""

    rotation_sigma: float = 0.02
    """How wrong recorded poses are about each axis (radians, standard deviation)."""

    max_translation: float = 0.2
    """A keyframe that fits only further away than this (metres) is not moved."""

    max_rotation: float = 0.1
    """A keyframe that fits only when turned by more than this (radians) is not moved."""

    min_overlap: float = 0.3
    """A keyframe with less than this share of its points near what others have measured is not moved."""

    def __post_init__(self) -> None:
        check_field(self.rounds >= 0, "poses.rounds", "must not be negative")
        check_field(self.translation_sigma > 0, "poses.translation_sigma", "must be positive")
        check_field(self.rotation_sigma > 0, "poses.rotation_sigma", "must be positive")
        check_field(self.max_translation > 0, "poses.max_translation", "must be positive")
        check_field(0 < self.max_rotation <= math.pi, "poses.max_rotation", "must lie between 0 and pi")
        check_field(0 <= self.min_overlap <= 1, "poses.min_overlap", "must lie between 0 and 1")
