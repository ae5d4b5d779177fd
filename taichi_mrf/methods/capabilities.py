"""The questions that tell whether a map has the verbs of MRFMap beyond those of all maps (OccupancyMap).

The rest of the program asks them instead of naming a method: the answer comes from the method's entry, and a
type checker then knows the verbs. A method of another package that says yes has the same verbs.
"""

from typing import TypeGuard

from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.moving_window import MovingWindow
from taichi_mrf.methods.protocol import OccupancyMap


def has_messages(m: OccupancyMap) -> TypeGuard[MRFMap]:
    """True if a map's keyframes keep messages: ``renew``, ``update_poses``, ``checkpoint``, ``restore``."""
    return m.METHOD.has_messages


def can_freeze(m: OccupancyMap) -> TypeGuard[MRFMap]:
    """True if a map can fold keyframes into itself for good: ``freeze_keyframe``, ``frozen``, ``window``."""
    return m.METHOD.can_freeze


def window_of(m: OccupancyMap) -> MovingWindow | None:
    """The window of a map that is not in memory as a whole, None for any other."""
    return m.window if can_freeze(m) else None


def can_refine_poses(m: OccupancyMap) -> TypeGuard[MRFMap]:
    """True if a map can align keyframes, and so be tracked in: ``refine_pose``, ``aligner``."""
    return m.METHOD.can_refine_poses


def has_layers(m: OccupancyMap) -> TypeGuard[MRFMap]:
    """True if a map can be read as of another time and by layers: ``layer``, ``decide``, ``changes``. In a
    map of a static world all but ``decide`` raise."""
    return m.METHOD.has_layers


def has_dates(m: OccupancyMap) -> TypeGuard[MRFMap]:
    """True if a map's world may change, so that it can be read as of another time and by layers."""
    return m.view.pool.dated is not None


def takes_colors(m: OccupancyMap) -> TypeGuard[MRFMap]:
    """True if keyframes of a map may have colour images."""
    return m.METHOD.has_colors


def measures_surface(m: OccupancyMap) -> TypeGuard[MRFMap]:
    """True if a map can make the surface that its keyframes measured: ``has_surface``, ``surface``."""
    return m.METHOD.measures_surface
