"""Actions of a user on the live page, as events for the page."""

from dataclasses import dataclass
from enum import Enum, auto

from taichi_mrf.viewer.transport.inbox import Event


class Action(Enum):
    """A button, or a widget whose value asks the mapping process for something."""

    PLAY = auto()
    PAUSE = auto()
    STEP = auto()
    SPEED = auto()
    RESET = auto()
    RESET_CONFIRMED = auto()
    CHOOSE_KEYFRAME = auto()
    SWITCH = auto()
    FREEZE = auto()
    FREEZE_CONFIRMED = auto()
    CANCELLED = auto()
    TOGGLE_GIZMO = auto()
    PUT_BACK = auto()
    SET_POSITION = auto()
    SHOW_PIXEL_RAY = auto()
    WATCH_IMAGES = auto()
    SHOW_TIME = auto()
    SAVE_MAP = auto()
    SAVE_VOXELS = auto()
    SAVE_MESH = auto()
    SAVE_PICTURE = auto()
    SAVE_PAGE = auto()
    RECORD = auto()


@dataclass(frozen=True)
class Clicked(Event):
    """A click into the scene: the ray from the viewpoint, in the world frame, metres."""

    origin: tuple[float, float, float]
    direction: tuple[float, float, float]


@dataclass(frozen=True)
class Dragged(Event):
    """The gizmo was grabbed, or let go where it is now."""

    holding: bool
